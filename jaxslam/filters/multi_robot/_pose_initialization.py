"""Initialization of a robot's pose in the map from one scan.

The pose x_b is a function g(y, q) of variables y of the map and of measurements q, so its
covariances are P_bM = G_y P_yM and P_bb = G_y P_yy G_yᵀ + G_q C G_qᵀ (as Solà (32)-(38) for a
landmark): correlated with the whole joint state. Every measurement is converted to a point in the
frame of its robot, for any sensor.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.core import slots
from jaxslam.core.slots import Joint
from jaxslam.core.types import Scan
from jaxslam.filters.multi_robot._team_filter import SIZE, TeamFilter, measures_points
from jaxslam.filters.multi_robot._team_state import InitialPose, pose_of
from jaxslam.linearize import _first_order as first_order
from jaxslam.math import se2
from jaxslam.math._linalg import symmetrize
from jaxslam.math.angles import wrap
from jaxslam.sensors._suite import Suite, split_scan


class _ObservedPoints(NamedTuple):
    """The measurements of a robot as points in its frame."""

    point: Float[Array, "M 2"]
    """[m]"""
    cov: Float[Array, "M 2 2"]
    tag: Int[Array, "M"]
    valid: Bool[Array, "M"]
    """mask of measurements of known identity that determine the point"""


Candidate = tuple[InitialPose, list[Bool[Array, "M"]]]
"""A pose for a robot, and masks of the measurements of each robot of the team it is made of."""


def best_initialization(
    filter: TeamFilter,
    joint: Joint,
    robot: int,
    observed: list[_ObservedPoints],
    in_map: Bool[Array, "R"],
) -> Candidate:
    """The candidate pose of a robot whose heading has the least variance.

    Args:
        observed: points observed by each robot.
        in_map: mask of the robots in the map.
    """
    candidates = [
        _mutual_candidate(filter, joint, robot, partner, observed, in_map[partner])
        for partner in range(len(observed))
        if partner != robot
    ]
    if len(observed[robot].tag) > 1:
        candidates.append(_landmark_candidate(filter, joint, robot, observed))
    heading = [jnp.where(new.possible, new.cov[2, 2], jnp.inf) for new, _ in candidates]
    best = jnp.argmin(jnp.stack(heading))
    chosen: Candidate = jax.tree.map(lambda *leaves: jnp.stack(leaves)[best], *candidates)
    return chosen


def _mutual_candidate(
    filter: TeamFilter,
    joint: Joint,
    robot: int,
    partner: int,
    observed: list[_ObservedPoints],
    in_map: Bool[Array, ""],
) -> Candidate:
    """The pose from a second robot in the map, if the two measure each other."""
    by_robot, by_partner = observed[robot], observed[partner]
    i, sees = _first(by_partner, filter.robot_tags[robot])
    j, sees_back = _first(by_robot, filter.robot_tags[partner])
    rows = filter.rows_of(partner)
    pose, pose_rows, pose_cov = by_mutual_sight(
        pose_of(filter, joint, partner),
        joint.cov[rows],
        joint.cov[rows, rows],
        (by_partner.point[i], by_partner.cov[i]),
        (by_robot.point[j], by_robot.cov[j]),
    )
    used = _no_measurements(observed)
    used[partner] = jnp.arange(len(used[partner])) == i
    used[robot] = jnp.arange(len(used[robot])) == j
    return InitialPose(pose, pose_rows, pose_cov, in_map & sees & sees_back), used


def _landmark_candidate(
    filter: TeamFilter, joint: Joint, robot: int, observed: list[_ObservedPoints]
) -> Candidate:
    """The pose from the two measured landmarks of the map that are farthest apart."""
    points, capacity = observed[robot], filter.capacity
    slot, in_map = slots.find(joint.tag[:capacity], joint.alive[:capacity], points.tag)
    usable = in_map & points.valid
    between = ((points.point[:, None] - points.point[None, :]) ** 2).sum(-1)
    size = between.shape
    both = usable[:, None] & usable[None, :] & jnp.triu(jnp.ones(size, bool), 1)
    i, j = jnp.unravel_index(jnp.argmax(jnp.where(both, between, -1.0)), size)
    two = both[i, j] & (between[i, j] > 0)
    measured, landmarks = jnp.stack([i, j]), jnp.stack([slot[i], slot[j]])
    # The rows x, y of both landmarks.
    at = (3 + landmarks[:, None] * SIZE + jnp.arange(2)[None, :]).reshape(-1)
    rows = joint.cov[at]
    pose, pose_rows, pose_cov = by_two_landmarks(
        joint.landmarks[landmarks, :2],
        rows,
        rows[:, at],
        points.point[measured],
        points.cov[measured],
    )
    used, m = _no_measurements(observed), jnp.arange(len(points.tag))
    used[robot] = (m == i) | (m == j)
    return InitialPose(pose, pose_rows, pose_cov, two & (landmarks[0] != landmarks[1])), used


def _no_measurements(observed: list[_ObservedPoints]) -> list[Array]:
    """Masks of no measurement of any robot."""
    return [jnp.zeros_like(points.valid) for points in observed]


def _first(observed: _ObservedPoints, tag: int) -> tuple[Int[Array, ""], Bool[Array, ""]]:
    """The first measurement with a tag, and whether it exists."""
    match = observed.valid & (observed.tag == tag)
    return jnp.argmax(match), match.any()


def observed_points(sensors: Suite, scan: Scan) -> _ObservedPoints:
    """A robot's scan as points; valid if a measurement has a tag and determines a point."""
    observed = []
    for part, part_scan in zip(sensors.parts, split_scan(scan, sensors.places), strict=True):
        if measures_points(part.sensor):
            z = part_scan.z[:, : len(part.sensor.measurements)]
            # Absent measurements are replaced by a value at which every model is smooth.
            z = jnp.where(part_scan.valid[:, None], z, 1.0)
            invert = jax.vmap(partial(first_order.invert_at, part.sensor), (None, 0, None, 0))
            origin = jnp.zeros(3, z.dtype)
            points, _, covs = invert(origin, z, origin, z)
            valid = part_scan.valid & (part_scan.tag >= 0)
        else:
            m, dtype = part.places, scan.z.dtype
            points, covs = jnp.zeros((m, 2), dtype), jnp.zeros((m, 2, 2), dtype)
            valid = jnp.zeros(m, bool)
        observed.append(_ObservedPoints(points, covs, part_scan.tag, valid))
    return _ObservedPoints(*(jnp.concatenate(leaves) for leaves in zip(*observed, strict=True)))


def by_mutual_sight(
    pose_a: Float[Array, "3"],
    rows: Float[Array, "3 D"],
    cov: Float[Array, "3 3"],
    seen: tuple[Float[Array, "2"], Float[Array, "2 2"]],
    back: tuple[Float[Array, "2"], Float[Array, "2 2"]],
) -> tuple[Float[Array, "3"], Float[Array, "3 D"], Float[Array, "3 3"]]:
    """The pose of a robot b that robot a measures and that measures a: mean, rows, covariance.

    With v the position of b measured by a, and w the position of a measured by b, r is the mean of
    |v| and |w| weighted by their inverse variances. In the frame of a, b is at r v/|v| with heading
    atan2(-v) - atan2(w); then x_b = x_a ∘ that pose.

    Args:
        pose_a, rows, cov: x_a, its covariance with all errors, and its covariance.
        seen, back: v and w, each with its covariance.
    """
    (v, cov_v), (w, cov_w) = seen, back
    # A weight is no variable of the estimate: its derivative is not part of the errors.
    share = jax.lax.stop_gradient(_distance_variance(w, cov_w))
    share = share / (share + jax.lax.stop_gradient(_distance_variance(v, cov_v)))

    def pose_b(pose_a: Array, v: Array, w: Array) -> Array:
        (range_v, bearing_v), (range_w, bearing_w) = se2.polar(v), se2.polar(w)
        r = share * range_v + (1 - share) * range_w
        position = se2.rectangular(jnp.stack([r, bearing_v]))
        # b sees a in the direction bearing_v + π of the frame of a, at bearing_w from its heading.
        turn = bearing_v + jnp.pi - bearing_w
        return se2.compose(pose_a, jnp.stack([position[0], position[1], turn]))

    by_a, by_v, by_w = jax.jacfwd(pose_b, argnums=(0, 1, 2))(pose_a, v, w)
    noise = by_v @ cov_v @ by_v.T + by_w @ cov_w @ by_w.T
    noise = symmetrize(by_a @ cov @ by_a.T + noise)
    return _wrap_heading(pose_b(pose_a, v, w)), by_a @ rows, noise


def by_two_landmarks(
    points: Float[Array, "2 2"],
    rows: Float[Array, "4 D"],
    cov: Float[Array, "4 4"],
    seen: Float[Array, "2 2"],
    seen_cov: Float[Array, "2 2 2"],
) -> tuple[Float[Array, "3"], Float[Array, "3 D"], Float[Array, "3 3"]]:
    """The pose of a robot that measures two landmarks of the map: mean, rows, covariance.

    The rigid motion that aligns the measured points q with the landmarks l (`se2.align`): the
    directions of l_2 - l_1 and q_2 - q_1 agree, and so do the midpoints.

    Args:
        points, rows, cov: l, its covariance with all errors, and its covariance.
        seen, seen_cov: q and its covariances.
    """

    def pose(points: Array, seen: Array) -> Array:
        return se2.align(seen, points)

    by_points, by_seen = jax.jacfwd(pose, argnums=(0, 1))(points, seen)
    # (3, landmark, coordinate) -> (3, 4), as the rows of both landmarks.
    by_points = by_points.reshape(3, 4)
    noise = jnp.einsum("ikl,klm,jkm->ij", by_seen, seen_cov, by_seen)
    noise = symmetrize(by_points @ cov @ by_points.T + noise)
    return _wrap_heading(pose(points, seen)), by_points @ rows, noise


def _distance_variance(point: Float[Array, "2"], cov: Float[Array, "2 2"]) -> Float[Array, ""]:
    """The variance of the distance of a point with that covariance; positive."""
    square = (point**2).sum()
    positive = square > 0
    along = point @ cov @ point / jnp.where(positive, square, 1.0)
    # Two distances without noise then have equal weights, and not 0/0.
    return jnp.where(along > 0, along, jnp.finfo(point.dtype).tiny)


def _wrap_heading(pose: Float[Array, "3"]) -> Float[Array, "3"]:
    return jnp.concatenate([pose[:2], wrap(pose[2:])])
