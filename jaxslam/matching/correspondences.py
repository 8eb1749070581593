"""The nearest point of a reference to each point of a scan, and which of these pairs count."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.graphs.solver.kernels import Kernel
from jaxslam.math.arrays import Number

FAR = 1e6
"""Coordinate [m] of a reference point that is not there, so that others are nearer."""


def nearest_points(reference: Float[Array, "M 2"], query: Float[Array, "N 2"]) -> Int[Array, "N"]:
    """The index of the nearest reference point of each query, by the matrix of all distances.

    The index stands in the last ⌈log₂ M⌉ bits of the squared distance, read as an integer, of which
    the least is sought: XLA computes that in vectors on a processor, and `argmin` it does not. So
    squared distances that differ by less than a share M ε count as equal, ε the dtype's.
    """
    count = reference.shape[0]
    dx = jax.lax.stop_gradient(reference[:, None, 0] - query[None, :, 0])
    dy = jax.lax.stop_gradient(reference[:, None, 1] - query[None, :, 1])
    square = dx * dx + dy * dy
    integer = jnp.int64 if square.dtype == jnp.float64 else jnp.int32
    key = jax.lax.bitcast_convert_type(square, integer)
    last = integer((1 << max(count - 1, 1).bit_length()) - 1)
    key = (key & ~last) | jnp.arange(count, dtype=integer)[:, None]
    return (key.min(axis=0) & last).astype(jnp.int32)


def weights(
    residual: Float[Array, "N"],
    possible: Bool[Array, "N"],
    kernel: Kernel | None,
    scale: Number,
    trim: Number | None = None,
) -> Float[Array, "N"]:
    """The weight of each pair: 0 where not possible or trimmed, else that of the kernel.

    Trimmed least squares keeps the ⌈trim · n⌉ of n possible pairs with the smallest residuals
    (Chetverikov et al. 2002, "The trimmed iterative closest point algorithm", ICPR).

    Args:
        kernel: of (residual/scale)².
    """
    kept = possible
    if trim is not None:
        size = jnp.where(possible, jnp.abs(residual), jnp.inf)
        count = jnp.ceil(trim * possible.sum()).astype(jnp.int32)
        limit = jnp.sort(size)[jnp.clip(count - 1, 0, len(size) - 1)]
        kept = possible & (size <= limit)
    weight = kept.astype(residual.dtype)
    if kernel is None:
        return weight
    square = jnp.where(kept, residual / scale, 0.0) ** 2
    return jnp.asarray(jax.lax.stop_gradient(weight * kernel.weight(square)))
