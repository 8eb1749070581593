"""KLD sampling: the number of particles by the bins that a sample occupies."""

import math

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.core.validation import positive, refusals_of, require
from jaxslam.math._arrays import Number
from jaxslam.math.stats import normal_quantile

# Bins are counted in int32, and a pose may be anywhere.
_FARTHEST = float(2**30)


def kld_bound(bins: Int[Array, "*K"], error: Number, confidence: float) -> Float[Array, "*K"]:
    """The number of particles that k = `bins` occupied bins require; 0 where k <= 1.

        n = (k-1)/(2ε) · (1 - 2/(9(k-1)) + √(2/(9(k-1))) z)³

    with z the standard normal quantile of the confidence: with that probability the Kullback-
    Leibler divergence of the sample's histogram from its distribution is below ε = error.
    2nK is χ² with k - 1 degrees of freedom, by Wilson & Hilferty's approximation (Fox 2001,
    "KLD-sampling: Adaptive particle filters"; Fox 2003, IJRR 22(12), eq. 7).

    Raises ValueError on a concrete error not above 0.
    """
    with refusals_of("kld_bound"):
        require("error", error, positive)
    z = normal_quantile(confidence)
    many = bins > 1
    dof = jnp.where(many, bins - 1, 1).astype(jnp.result_type(float))
    part = 2 / (9 * dof)
    return jnp.where(many, dof / (2 * error) * (1 - part + jnp.sqrt(part) * z) ** 3, 0.0)


def bins_of(pose: Float[Array, "P 3"], size: tuple[float, float, float]) -> Int[Array, "P 3"]:
    """The bin of each pose, int32: whole multiples of size (x [m], y [m], θ [rad]).

    Headings from -π on, the last bin being narrower where size does not divide 2π.
    """
    scale = jnp.asarray(size, pose.dtype)
    at = jnp.concatenate([pose[:, :2], pose[:, 2:] + math.pi], axis=1) / scale[None]
    last = math.ceil(2 * math.pi / size[2] - 1e-9) - 1
    at = at.at[:, 2].set(jnp.clip(at[:, 2], 0, last))
    return jnp.floor(jnp.clip(at, -_FARTHEST, _FARTHEST)).astype(jnp.int32)


def count_distinct(bins: Int[Array, "P 3"]) -> Int[Array, "P"]:
    """The number of distinct rows among the first 1, 2, …, P bins, int32.

    By a stable sort, O(P log P) in time and O(P) in memory for any size of the world: among equal
    rows the first drawn comes first.
    """
    index = jnp.arange(bins.shape[0], dtype=jnp.int32)
    x, y, heading, order = jax.lax.sort(
        (bins[:, 0], bins[:, 1], bins[:, 2], index), num_keys=3, is_stable=True
    )
    rows = jnp.stack([x, y, heading])
    new = jnp.concatenate([jnp.ones(1, bool), (rows[:, 1:] != rows[:, :-1]).any(axis=0)])
    first = jnp.zeros(bins.shape[0], bool).at[order].set(new)
    return jnp.cumsum(first.astype(jnp.int32))


def enough(
    bins: Int[Array, "P 3"], least: int, error: Number, confidence: float
) -> tuple[Int[Array, ""], Bool[Array, ""]]:
    """The sufficient number of P exchangeable draws, int32, and whether P are too few.

    Fox's loop in fixed shapes: the first m >= least that is no less than `kld_bound` of the bins
    that the first m draws occupy; P where there is none.

    Args:
        bins: of the draws, in random order; an ordered sample (as from systematic resampling)
            has to be shuffled before.
    """
    count = bins.shape[0]
    size = jnp.arange(1, count + 1)
    bound = kld_bound(count_distinct(bins), error, confidence)
    fits = (size >= least) & (size.astype(bound.dtype) >= bound)
    some = fits.any()
    return jnp.where(some, jnp.argmax(fits) + 1, count).astype(jnp.int32), ~some
