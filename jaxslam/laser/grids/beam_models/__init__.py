"""How likely the ranges of a laser are at a pose in a grid."""

from jaxslam._public import publish
from jaxslam.laser.grids.beam_models._beam_model import BeamModel, log_likelihood
from jaxslam.laser.grids.beam_models._likelihood_field import LikelihoodField
from jaxslam.laser.grids.beam_models._ray_cast import Mixture, RayCast, fit, mixture_log_density

REGISTRY: dict[str, type[BeamModel]] = {
    "likelihood_field": LikelihoodField,
    "ray_cast": RayCast,
}
"""By name; each takes max_range and the mount of the laser."""

__all__ = [
    "REGISTRY",
    "BeamModel",
    "LikelihoodField",
    "Mixture",
    "RayCast",
    "fit",
    "log_likelihood",
    "mixture_log_density",
]

publish(__name__)
