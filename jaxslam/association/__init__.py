"""Data association: methods that match measurements with landmarks."""

from jaxslam.association.certain import certain
from jaxslam.association.global_nearest import global_nearest
from jaxslam.association.joint import joint
from jaxslam.association.known import known
from jaxslam.association.maximum_likelihood import maximum_likelihood
from jaxslam.association.nearest import nearest

__all__ = ["certain", "global_nearest", "joint", "known", "maximum_likelihood", "nearest"]
