"""Residual resampling: ⌊P w_j⌋ copies of each particle, and random draws for the rest."""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxslam.resampling.weights import at_points, weights_of


def residual(log_weights: Float[Array, "P"], key: Array) -> Int[Array, "P"]:
    """Ancestors (P,) by residual resampling: ⌊P w_j⌋ copies of each j, then random draws.

    The R = P - Σ ⌊P w_j⌋ draws are independent with probabilities (P w_j - ⌊P w_j⌋)/R.

    Unbiased as `multinomial`, with less variance (Liu & Chen 1998, "Sequential Monte Carlo methods
    for dynamic systems", JASA 93(443)). The copies come first, ascending.

    Args:
        log_weights: of any scale; non-finite ones are never drawn, unless none is finite.
        key: a PRNG key, consumed.
    """
    weights = weights_of(log_weights)
    count = weights.shape[0]
    share = count * weights
    # P·(1/P) may be rounded to less than 1.
    copies = jnp.floor(share * (1 + 4 * float(jnp.finfo(share.dtype).eps)))
    rest = jnp.maximum(share - copies, 0.0)
    index = jnp.arange(count)
    copied = jnp.searchsorted(jnp.cumsum(copies), index.astype(share.dtype), side="right")
    drawn = at_points(rest, jax.random.uniform(key, (count,), weights.dtype))
    return jnp.where(index < copies.sum(), copied, drawn).astype(jnp.int32)
