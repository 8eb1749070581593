"""How a robot that is nowhere in the map finds its place in it, from one scan.

Its pose x_b is a function g(y, q) of what the map holds, y, and of what was seen, q, so it enters
with P_bM = G_y P_yM and P_bb = G_y P_yy G_yᵀ + G_q C G_qᵀ (as Solà (32)-(38) for a landmark):
correlated with the whole joint state. Everything seen is a point in the frame of the robot that saw
it, whatever the sensor.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.linearize import first_order
from jaxslam.math import se2
from jaxslam.math.angles import wrap
from jaxslam.math.linalg import symmetrize
from jaxslam.protocols import Sensor

Array = jax.Array


class Sightings(NamedTuple):
    """What a robot sees in full, as points in its own frame; M places."""

    point: Array
    """(M, 2) [m]"""
    cov: Array
    """(M, 2, 2)"""
    tag: Array
    """(M,) int"""
    valid: Array
    """(M,) bool"""


class Entry(NamedTuple):
    """A place in the map that a robot may take."""

    pose: Array
    """(3,)"""
    rows: Array
    """(3, D) G_y P_y: its covariance with all errors of the map"""
    cov: Array
    """(3, 3)"""
    possible: Array
    """() bool"""


def sightings(sensor: Sensor, z: Array, tag: Array, valid: Array) -> Sightings:
    """Points (M, 2) in the robot's frame of measurements z (M, Z) that leave nothing free."""
    origin = jnp.zeros(3, z.dtype)

    def one(z: Array) -> tuple[Array, Array]:
        point, _, cov = first_order.invert_at(sensor, origin, z, origin, z)
        return point, cov

    # What is not there is put where every model is smooth.
    points, covs = jax.vmap(one)(jnp.where(valid[:, None], z, 1.0))
    return Sightings(points, covs, tag, valid & (tag >= 0))


def by_mutual_sight(
    other: Array, rows: Array, cov: Array, seen: tuple[Array, Array], back: tuple[Array, Array]
) -> tuple[Array, Array, Array]:
    """The pose of a robot b that robot a sees and that sees a: mean, rows (3, D), covariance.

    With v where a sees b and w where b sees a, |v| and |w| are one distance measured twice, r their
    average, weighted by their variances. In the frame of a, b stands at r v/|v| and is turned by
    atan2(-v) - atan2(w); then x_b = x_a ∘ that.

    Args:
        other, rows, cov: x_a (3,), its covariance with all errors (3, D) and its own (3, 3).
        seen, back: v and w, each with its covariance (2,), (2, 2).
    """
    (v, cov_v), (w, cov_w) = seen, back
    share = jax.lax.stop_gradient(_distance_variance(w, cov_w))
    share = share / (share + jax.lax.stop_gradient(_distance_variance(v, cov_v)))

    def pose(other: Array, v: Array, w: Array) -> Array:
        (far, at_v), (back, at_w) = se2.polar(v), se2.polar(w)
        there = se2.rectangular(jnp.stack([share * far + (1 - share) * back, at_v]))
        turn = at_v + jnp.pi - at_w
        return se2.compose(other, jnp.stack([there[0], there[1], turn]))

    by_other, by_v, by_w = jax.jacfwd(pose, argnums=(0, 1, 2))(other, v, w)
    own = by_v @ cov_v @ by_v.T + by_w @ cov_w @ by_w.T
    own = symmetrize(by_other @ cov @ by_other.T + own)
    return _wrapped(pose(other, v, w)), by_other @ rows, own


def by_two_landmarks(
    points: Array, rows: Array, cov: Array, seen: Array, seen_cov: Array
) -> tuple[Array, Array, Array]:
    """The pose of a robot that sees two landmarks of the map: mean, rows (3, D), covariance.

    The rigid motion that carries what is seen, q (2, 2), onto the landmarks l (2, 2) best
    (`se2.align`): headings of l_2 - l_1 and q_2 - q_1 agree, and so do the middles.

    Args:
        points, rows, cov: l, its covariance with all errors (4, D) and its own (4, 4).
        seen, seen_cov: q and its covariances (2, 2, 2).
    """

    def pose(points: Array, seen: Array) -> Array:
        return se2.align(seen, points)

    by_points, by_seen = jax.jacfwd(pose, argnums=(0, 1))(points, seen)
    by_points = by_points.reshape(3, 4)
    own = jnp.einsum("ikl,klm,jkm->ij", by_seen, seen_cov, by_seen)
    own = symmetrize(by_points @ cov @ by_points.T + own)
    return _wrapped(pose(points, seen)), by_points @ rows, own


def farthest_pair(points: Array, usable: Array) -> tuple[Array, Array, Array]:
    """The places i < j of the usable points (M, 2) farthest from each other, and whether there are
    two that differ."""
    m = points.shape[0]
    between = ((points[:, None] - points[None, :]) ** 2).sum(-1)
    both = usable[:, None] & usable[None, :] & jnp.triu(jnp.ones((m, m), bool), 1)
    best = jnp.argmax(jnp.where(both, between, -1.0))
    i, j = best // m, best % m
    return i, j, both[i, j] & (between[i, j] > 0)


def _distance_variance(point: Array, cov: Array) -> Array:
    """Of the distance of a point (2,) with that covariance (2, 2); positive."""
    square = (point**2).sum()
    there = square > 0
    along = point @ cov @ point / jnp.where(there, square, 1.0)
    return jnp.where(along > 0, along, jnp.finfo(point.dtype).tiny)


def _wrapped(pose: Array) -> Array:
    return jnp.concatenate([pose[:2], wrap(pose[2:])])
