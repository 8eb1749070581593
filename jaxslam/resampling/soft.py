"""Soft resampling: ancestors drawn from flattened weights; its gradient is biased."""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxslam.core.numbers import is_concrete
from jaxslam.core.record import hold_function, record
from jaxslam.math.arrays import Number
from jaxslam.protocols import Resample
from jaxslam.resampling.systematic import systematic
from jaxslam.resampling.weights import even, normalized


@record
class Soft:
    """Soft resampling: draws from a mixture of the weights and the uniform distribution.

    Karkus, Hsu & Lee 2018, "Particle filter networks with application to visual localization",
    CoRL:

        q_j = share · w_j + (1 - share)/P        weight of a copy of j: (w_j/q_j)/P

    The weights of the copies are divided by their sum, as a number; gradients go through w_j/q_j.

    **Biased**: expectations are correct, but the draws from q depend on the parameters too, and
    the gradient ignores this. share = 1 is plain resampling, whose copies all have weight 1/P and
    pass no gradient; share = 0 has an unbiased gradient, and does not resample by weight.
    `stop_gradient` is unbiased for any method.

    Raises ValueError on a share outside [0, 1].
    """

    share: Number
    """of the weights in the mixture, 0 to 1"""
    resample: Resample = systematic
    """how indices are drawn from q"""

    def __post_init__(self) -> None:
        hold_function(self, "resample", "log_weights, key")
        if is_concrete(self.share) and not 0 <= self.share <= 1:
            raise ValueError(f"Soft: expected a share from 0 to 1, got {self.share}")

    def __call__(
        self, log_weights: Float[Array, "P"], key: Array
    ) -> tuple[Int[Array, "P"], Float[Array, "P"]]:
        log_w = normalized(log_weights)[0]
        w = jnp.exp(log_w)
        share = jnp.asarray(self.share, w.dtype)
        q = share * w + (1 - share) / w.shape[0]
        drawn = q > 0
        log_q = jnp.log(jnp.where(drawn, q, 1.0))
        ancestor = self.resample(jax.lax.stop_gradient(jnp.where(drawn, log_q, -jnp.inf)), key)
        # A ratio of logarithms where there is a weight: double where, for the gradient.
        there = w > 0
        ratio = jnp.where(there, log_w, 0.0) - jnp.where(there, log_q, 0.0)
        ratio = jnp.where(there, ratio, -jnp.inf)[ancestor]
        _, log_sum, some = normalized(jax.lax.stop_gradient(ratio))
        return ancestor, jnp.where(some, ratio - log_sum, even(log_weights))
