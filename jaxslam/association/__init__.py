"""Data association: methods that match measurements with landmarks."""

from jaxslam.association.joint_compatibility import JointCompatibility
from jaxslam.association.rules import Certain, GlobalNearest, Known, MaximumLikelihood, Nearest

__all__ = [
    "Certain",
    "GlobalNearest",
    "JointCompatibility",
    "Known",
    "MaximumLikelihood",
    "Nearest",
]
