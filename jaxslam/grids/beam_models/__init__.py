"""How likely the ranges of a laser are at a pose in a grid."""

from jaxslam.grids.beam_models.beam_model import BeamModel, log_likelihood
from jaxslam.grids.beam_models.fitting import fit
from jaxslam.grids.beam_models.likelihood_field import likelihood_field
from jaxslam.grids.beam_models.ray_cast import Mixture, mixture_log_density, ray_cast

__all__ = [
    "BeamModel",
    "Mixture",
    "fit",
    "likelihood_field",
    "log_likelihood",
    "mixture_log_density",
    "ray_cast",
]
