"""How likely the ranges of a laser are at a pose in a grid."""

from collections.abc import Callable

from jaxslam.grids.beam_models.beam_model import BeamModel, log_likelihood
from jaxslam.grids.beam_models.fitting import fit
from jaxslam.grids.beam_models.likelihood_field import likelihood_field
from jaxslam.grids.beam_models.ray_cast import Mixture, mixture_log_density, ray_cast

REGISTRY: dict[str, Callable[..., BeamModel]] = {
    "likelihood_field": likelihood_field,
    "ray_cast": ray_cast,
}
"""By name; each takes max_range and the mount of the laser."""

__all__ = [
    "REGISTRY",
    "BeamModel",
    "Mixture",
    "fit",
    "likelihood_field",
    "log_likelihood",
    "mixture_log_density",
    "ray_cast",
]
