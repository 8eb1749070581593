"""Resampling methods of particle filters. Their tests run over `REGISTRY`.

`soft` and `stop_gradient` make a method differentiable; `kld` says how many particles suffice.
"""

from jaxslam.protocols import Resample
from jaxslam.resampling.kld import kld_bound
from jaxslam.resampling.multinomial import multinomial
from jaxslam.resampling.residual import residual
from jaxslam.resampling.soft import soft
from jaxslam.resampling.stop_gradient import stop_gradient
from jaxslam.resampling.stratified import stratified
from jaxslam.resampling.systematic import systematic

REGISTRY: dict[str, Resample] = {
    "multinomial": multinomial,
    "residual": residual,
    "stratified": stratified,
    "systematic": systematic,
}

__all__ = [
    "REGISTRY",
    "kld_bound",
    "multinomial",
    "residual",
    "soft",
    "stop_gradient",
    "stratified",
    "systematic",
]
