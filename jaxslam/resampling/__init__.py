"""Resampling methods of particle filters. Their tests run over `REGISTRY`.

`Soft` and `StopGradient` make a method differentiable; `kld` bounds the necessary number of
particles.
"""

from jaxslam._public import publish
from jaxslam.core._names import Named
from jaxslam.core.protocols import Resample
from jaxslam.resampling._kld import kld_bound
from jaxslam.resampling._methods import (
    Soft,
    StopGradient,
    multinomial,
    residual,
    stratified,
    systematic,
)

REGISTRY: dict[str, Resample] = Named(
    {
        "multinomial": multinomial,
        "residual": residual,
        "stratified": stratified,
        "systematic": systematic,
    }
)

__all__ = [
    "REGISTRY",
    "Soft",
    "StopGradient",
    "kld_bound",
    "multinomial",
    "residual",
    "stratified",
    "systematic",
]

publish(__name__)
