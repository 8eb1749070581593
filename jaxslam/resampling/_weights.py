"""Particle weights: normalization, effective sample size, indices in the cumulative sum."""

from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.core.protocols import Differentiable, Resample
from jaxslam.core.validation import InvalidField
from jaxslam.math._xla import where_any

_T = TypeVar("_T")


def normalize(
    log_weights: Float[Array, "P"],
) -> tuple[Float[Array, "P"], Float[Array, ""], Bool[Array, ""]]:
    """Normalized log-weights (Σ w = 1), log Σ exp(log_weights), and whether that sum is positive.

    Log-weights that are not finite give weight zero. If all are, each weight is 1/P, the flag is
    False and the log of the sum is given as 0.

    Raises ValueError unless log_weights has shape (P,), P at least 1.
    """
    if jnp.ndim(log_weights) != 1 or jnp.shape(log_weights)[0] == 0:
        reason = f"expected shape (P,), P at least 1, got {jnp.shape(log_weights)}"
        raise InvalidField("log_weights", reason, owner="normalized")
    finite = jnp.isfinite(log_weights)
    some = finite.any()
    highest = jnp.where(some, jnp.max(jnp.where(finite, log_weights, -jnp.inf)), 0.0)
    safe = jnp.where(finite, log_weights - highest, 0.0)
    total = jnp.where(finite, jnp.exp(safe), 0.0).sum()
    log_total = jnp.where(some, jnp.log(jnp.where(some, total, 1.0)), 0.0)
    log_w = jnp.where(finite, safe - log_total, -jnp.inf)
    return jnp.where(some, log_w, even(log_weights)), highest + log_total, some


def even(log_weights: Float[Array, "P"]) -> Float[Array, ""]:
    """Equal log-weights: log 1/P each."""
    return -jnp.log(jnp.asarray(float(log_weights.shape[0]), log_weights.dtype))


def survivors(
    resample: Resample | Differentiable, log_weights: Float[Array, "P"], key: Array
) -> tuple[Int[Array, "P"], Float[Array, "P"]]:
    """The ancestors and their log-weights: log 1/P unless the method is a `Differentiable`, which
    returns its own."""
    result = resample(log_weights, key)
    if isinstance(result, tuple):
        return result
    return result, jnp.broadcast_to(even(log_weights), log_weights.shape)


def resampled_where(
    due: Bool[Array, ""],
    particles: _T,
    log_weights: Float[Array, "P"],
    resample: Resample | Differentiable,
    key: Array,
) -> tuple[_T, Float[Array, "P"]]:
    """Particles, a tree of arrays (P, …), and their log-weights, resampled if `due`.

    In a batch without a due run nothing is copied.
    """

    def survive(carried: tuple[_T, Array]) -> tuple[_T, Array]:
        particles, log_weights = carried
        chosen, after = survivors(resample, log_weights, key)
        ancestor = jnp.where(due, chosen, jnp.arange(log_weights.shape[0], dtype=chosen.dtype))
        copies: _T = jax.tree.map(lambda leaf: leaf[ancestor], particles)
        return copies, jnp.where(due, after, log_weights)

    return where_any(due, survive, lambda carried: carried, (particles, log_weights))


def weights_of(log_weights: Float[Array, "P"]) -> Float[Array, "P"]:
    """Weights w with Σ w = 1 of log-weights of any scale; equal where all underflow."""
    return jnp.exp(normalize(log_weights)[0])


def effective_size(log_weights: Float[Array, "P"]) -> Float[Array, ""]:
    """Effective sample size 1/Σ w², between 1 and P (Kong, Liu & Wong 1994, "Sequential imputations
    and Bayesian missing data problems", JASA 89(425))."""
    return 1.0 / (weights_of(log_weights) ** 2).sum()


def at_points(weights: Float[Array, "P"], points: Float[Array, "K"]) -> Int[Array, "K"]:
    """The index of the interval of the cumulative sum of weights in which each point lies, int32.

    points are in [0, 1); the share of i is [W_{i-1}, W_i)/W_P, so that no zero weight is chosen,
    also where a point is rounded up to 1.
    """
    above = jnp.cumsum(weights)
    index = jnp.searchsorted(above, points * above[-1], side="right")
    # The last index with a weight: a point rounded up to 1 would be beyond it.
    last = weights.shape[0] - 1 - jnp.argmax((weights > 0)[::-1])
    return jnp.minimum(index.astype(jnp.int32), last.astype(jnp.int32))
