"""Data association: methods that match measurements with landmarks."""

from jaxslam._public import publish
from jaxslam.association._joint_compatibility import JointCompatibility
from jaxslam.association._rules import Certain, GlobalNearest, Known, MaximumLikelihood, Nearest

__all__ = [
    "Certain",
    "GlobalNearest",
    "JointCompatibility",
    "Known",
    "MaximumLikelihood",
    "Nearest",
]

publish(__name__)
