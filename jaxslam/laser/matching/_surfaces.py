"""The surface that a scan samples, a line through the neighbours of each point; pairs of points.

Each point of a scan is paired with its nearest point of a reference; `weights` rejects pairs.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.graphs._solver.kernels import Kernel
from jaxslam.laser.matching._outcome import information_along
from jaxslam.laser.matching._point_sets import Points
from jaxslam.math import se2
from jaxslam.math._arrays import Number

SPAN = 5
"""Neighbours on each side of a point that a line is fitted to."""

GAP = 0.5
"""[m] between points beyond which they are not neighbours."""

_BENT = 4.0
"""Times the median variance of the points across a line above which it goes round a corner
(chosen: twice their scatter)."""

_FLAT = 1e-3
"""[m] Points that scatter less than this form a line: in a scan without noise, where the median
variance is 0."""

_LONG = 0.1
"""Largest variance across a line relative to the variance along it."""


class Surface(NamedTuple):
    """Points of a reference, each with the line fitted to it and its neighbours."""

    position: Float[Array, "M 2"]
    """[m]; far away without a point"""
    middle: Float[Array, "M 2"]
    """a point of the line: the mean of the neighbours"""
    normal: Float[Array, "M 2"]
    """unit vector across the line"""
    tilt: Float[Array, "M"]
    """variance of the direction of the line [rad²], by how far the neighbours are from it"""
    straight: Bool[Array, "M"]
    """whether there is a line: three neighbours or more, along it rather than across, which scatter
    about it as they do elsewhere, so that it goes round no corner"""


def surface(
    of: Points, span: int | Array = SPAN, gap: Number = GAP, *, most: int | None = None
) -> Surface:
    """The lines through up to 2 span + 1 neighbours, in the order of the beams.

    Neighbours are those up to which no two points that follow each other are more than `gap` [m]
    apart. The line is that of least squared distances: with the moments S = Σ (p - m)(p - m)ᵀ its
    direction is ½ atan2(2 S_xy, S_xx - S_yy). With eigenvalues λ₁ >= λ₂ of S and n points, the
    variance of a point across it is estimated by λ₂/(n - 2), and that of the direction by
    λ₂/((n - 2) λ₁). Differentiable by the positions. A traced span needs `most`, its largest value.
    """
    p, valid = of.position, of.valid
    step = jnp.where(valid[1:] & valid[:-1], ((p[1:] - p[:-1]) ** 2).sum(axis=1), jnp.inf)
    # Entry k: whether points k - 1 and k are neighbours; the ends of the scan have none, so that
    # rolling joins nothing across the seam.
    joined = jnp.concatenate([jnp.zeros(1, bool), step < gap**2, jnp.zeros(1, bool)])
    weight = [valid.astype(p.dtype)]
    shifted = [p]
    for side in (-1, 1):
        reached = valid
        for k in range(1, (span if most is None else most) + 1):
            # The join between neighbours k-1 and k on this side of each point.
            link = jnp.roll(joined[1:], -(k - 1)) if side == 1 else jnp.roll(joined[:-1], k - 1)
            reached = reached & link & (k <= span)
            weight.append(reached.astype(p.dtype))
            shifted.append(jnp.roll(p, -side * k, axis=0))
    w, q = jnp.stack(weight), jnp.stack(shifted)
    n = w.sum(axis=0)
    middle = (w[..., None] * q).sum(axis=0) / jnp.maximum(n, 1)[:, None]
    d = jnp.where(w[..., None] > 0, q - middle[None], 0.0)
    xx, yy, xy = (d[..., 0] ** 2).sum(0), (d[..., 1] ** 2).sum(0), (d[..., 0] * d[..., 1]).sum(0)
    flat, cross = xx - yy, 2 * xy
    size = flat**2 + cross**2
    # Too few points, or a round cloud, have no direction; any, with finite derivatives.
    has_no_line = ~((n >= 3) & (size > 0))
    flat, cross, size = (
        jnp.where(has_no_line, safe, value)
        for value, safe in ((flat, 1.0), (cross, 0.0), (size, 1.0))
    )
    root = jnp.sqrt(size)
    direction = 0.5 * jnp.arctan2(cross, flat)
    largest, least = 0.5 * (xx + yy + root), jnp.maximum(0.5 * (xx + yy - root), 0.0)
    variance = least / jnp.maximum(n - 2, 1)
    # The median of the points with a line; a threshold, through which no derivative goes.
    ordered = jnp.sort(jnp.where(has_no_line, jnp.inf, variance))
    usual = ordered[jnp.maximum((~has_no_line).sum() - 1, 0) // 2]
    usual = jax.lax.stop_gradient(jnp.where((~has_no_line).any(), usual, 0.0))
    return Surface(
        position=jnp.where(valid[:, None], p, _FAR),
        middle=jnp.where(has_no_line[:, None], p, middle),
        normal=jnp.stack([-jnp.sin(direction), jnp.cos(direction)], axis=-1),
        tilt=variance / jnp.where(has_no_line, 1.0, largest),
        straight=~has_no_line & (least < _LONG * largest) & (variance < _BENT * usual + _FLAT**2),
    )


def surface_at(of: Surface, pose: Float[Array, "3"]) -> Surface:
    """The surface, given in the frame of a pose, in the frame in which the pose is given."""
    turn = se2.rotation(pose[2]).T
    return of._replace(
        position=of.position @ turn + pose[None, :2],
        middle=of.middle @ turn + pose[None, :2],
        normal=of.normal @ turn,
    )


def surface_information(
    of: Surface, pose: Float[Array, "3"], weight: Float[Array, "M"]
) -> Float[Array, "3 3"]:
    """The information Σ w J Jᵀ of a scan at a pose, by the lines through its points."""
    turn = se2.rotation(pose[2]).T
    arm = jnp.where((weight > 0)[:, None], of.position @ turn, 0.0)
    return information_along(of.normal @ turn, of.tilt, arm, jnp.where(of.straight, weight, 0.0))


_FAR = 1e6
"""Coordinate [m] of a missing reference point, so that others are nearer."""


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
        count = jnp.ceil(trim * possible.sum(dtype=residual.dtype)).astype(jnp.int32)
        limit = jnp.sort(size)[jnp.clip(count - 1, 0, len(size) - 1)]
        kept = possible & (size <= limit)
    weight = kept.astype(residual.dtype)
    if kernel is None:
        return weight
    square = jnp.where(kept, residual / scale, 0.0) ** 2
    return jnp.asarray(jax.lax.stop_gradient(weight * kernel.weight(square)))
