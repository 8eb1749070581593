"""Data association: methods that match measurements with landmarks."""

from jaxslam.association.certain import Certain
from jaxslam.association.global_nearest import GlobalNearest
from jaxslam.association.joint_compatibility import JointCompatibility
from jaxslam.association.known import Known
from jaxslam.association.maximum_likelihood import MaximumLikelihood
from jaxslam.association.nearest import Nearest

__all__ = [
    "Certain",
    "GlobalNearest",
    "JointCompatibility",
    "Known",
    "MaximumLikelihood",
    "Nearest",
]
