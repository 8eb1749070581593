"""The surface that a scan samples: a line through the neighbours of each point."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam.matching.correspondences import FAR
from jaxslam.matching.outcome import information_along
from jaxslam.matching.points import Points
from jaxslam.math import se2
from jaxslam.math.arrays import Number

SPAN = 5
"""Neighbours on each side of a point that a line is fitted to."""

GAP = 0.5
"""[m] between points beyond which they are not neighbours."""

_BENT = 4.0
"""A line whose points scatter by more than this times the median variance goes round a corner."""

_FLAT = 1e-3
"""[m] Points that scatter less than this are of a line."""


class Surface(NamedTuple):
    """Points of a reference, each with the line fitted to it and its neighbours."""

    position: Float[Array, "M 2"]
    """[m]; far away where there is no point"""
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
    round_ = ~((n >= 3) & (size > 0))
    flat, cross, size = (
        jnp.where(round_, one, x) for x, one in ((flat, 1.0), (cross, 0.0), (size, 1.0))
    )
    root = jnp.sqrt(size)
    direction = 0.5 * jnp.arctan2(cross, flat)
    largest, least = 0.5 * (xx + yy + root), jnp.maximum(0.5 * (xx + yy - root), 0.0)
    variance = least / jnp.maximum(n - 2, 1)
    usual = jax.lax.stop_gradient(_median(variance, ~round_))
    return Surface(
        position=jnp.where(valid[:, None], p, FAR),
        middle=jnp.where(round_[:, None], p, middle),
        normal=jnp.stack([-jnp.sin(direction), jnp.cos(direction)], axis=-1),
        tilt=variance / jnp.where(round_, 1.0, largest),
        straight=~round_ & (least < 0.1 * largest) & (variance < _BENT * usual + _FLAT**2),
    )


def surface_at(of: Surface, pose: Float[Array, "3"]) -> Surface:
    """A surface that is given in the frame of a pose, in the coordinates of the pose's frame."""
    turn = se2.rotation(pose[2]).T
    return of._replace(
        position=of.position @ turn + pose[None, :2],
        middle=of.middle @ turn + pose[None, :2],
        normal=of.normal @ turn,
    )


def surface_information(
    of: Surface, pose: Float[Array, "3"], weight: Float[Array, "M"]
) -> Float[Array, "3 3"]:
    """The information Σ w J Jᵀ of a scan at a pose, by the lines through its own points."""
    turn = se2.rotation(pose[2]).T
    arm = jnp.where((weight > 0)[:, None], of.position @ turn, 0.0)
    return information_along(of.normal @ turn, of.tilt, arm, jnp.where(of.straight, weight, 0.0))


def _median(values: Float[Array, "M"], there: Bool[Array, "M"]) -> Float[Array, ""]:
    """The median of the values that are there; 0 of none."""
    ordered = jnp.sort(jnp.where(there, values, jnp.inf))
    middle = ordered[jnp.maximum(there.sum() - 1, 0) // 2]
    return jnp.where(there.any(), middle, 0.0)
