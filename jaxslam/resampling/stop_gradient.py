"""Stop-gradient resampling: weights of value 1/P whose gradient is the score of the draw."""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxslam.core.record import hold_function, record
from jaxslam.protocols import Resample
from jaxslam.resampling.systematic import systematic
from jaxslam.resampling.weights import even, normalized


@record
class StopGradient:
    """The stop-gradient estimator (Ścibior & Wood 2021, "Differentiable particle filtering without
    modifying the forward pass"): a copy of j has the weight

        (1/P) · w_j/⊥(w_j)        ⊥ being `jax.lax.stop_gradient`

    that is 1/P, so values do not change; its derivative is (1/P) ∂ log w_j, and

        E Σ_i (1/P) f(a_i) ∂ log w_{a_i} = Σ_j f_j ∂w_j

    **Unbiased** for expectations, so that the gradient of the filter's estimate of the likelihood
    has the gradient of the likelihood for its mean, and that of its logarithm tends to the score
    with the number of particles (its bias is of order 1/P, as that of the logarithm itself). The
    price is variance, which grows with the length of the log: all terms of a lineage that dies out
    are lost.

    A caller must not normalize these weights again: their sum is 1, but its gradient is not 0.
    """

    resample: Resample = systematic
    """how indices are drawn; unbiased, as those of `jaxslam.resampling` are"""

    def __post_init__(self) -> None:
        hold_function(self, "resample", "log_weights, key")

    def __call__(
        self, log_weights: Float[Array, "P"], key: Array
    ) -> tuple[Int[Array, "P"], Float[Array, "P"]]:
        log_w, _, some = normalized(log_weights)
        ancestor = self.resample(jax.lax.stop_gradient(log_weights), key)
        chosen = jnp.where(some, log_w, 0.0)[ancestor]
        # Particles of weight zero are not drawn; the where keeps gradients of the others finite.
        chosen = jnp.where(jnp.isfinite(chosen), chosen, 0.0)
        return ancestor, even(log_weights) + (chosen - jax.lax.stop_gradient(chosen))
