"""Relocalization of a lost robot in its map by geometric matching of one scan."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxslam.core.protocols import Chart, Sensor
from jaxslam.core.slots import Joint
from jaxslam.core.types import Scan
from jaxslam.core.validation import InvalidField, array_of, covariance, refusals_of, require
from jaxslam.filters._ekf.map_coordinates import cov_of_coordinates, with_cov_of_coordinates
from jaxslam.filters.map_management._geometric_matching import (
    GeometricMatch,
    align_points,
    check_point_map,
    check_search,
    match_points,
    search_limits,
)
from jaxslam.filters.map_management._point_pairs import PointSets
from jaxslam.math import _linalg as linalg

__all__ = ["forget_pose", "points_of_map", "relocalize", "replace_pose", "seen_points"]


class _Relocalization(NamedTuple):
    """The pose from which a scan was taken, and its match with the map."""

    pose: Float[Array, "3"]
    """pose of the robot [m, m, rad]; zeros where nothing agreed"""
    slot: Int[Array, "M"]
    """landmark of each measurement, -1 for none"""
    explained: Int[Array, ""]
    """number of measurements that fit jointly"""
    runner_up: Int[Array, ""]
    """number of measurements explained by the second-best pose"""
    distance: Float[Array, ""]
    """D² of the explained measurements, χ² of 2·explained - 3 degrees of freedom"""
    ok: Bool[Array, ""]
    """enough points match, and clearly more than at any other pose"""
    exhausted: Bool[Array, ""]
    """more pairs agreed than were tried"""


def seen_points(sensor: Sensor, scan: Scan) -> tuple[Float[Array, "M 2"], Float[Array, "M 2 2"]]:
    """A scan as points in the robot's frame, and their covariances.

    p = position(invert(0, z)), P = J R Jᵀ with J = ∂p/∂z; zeros and identity where not valid.
    Raises ValueError for a sensor without landmarks, of landmarks without a position (lines), or
    whose measurement does not determine the position (K > 0).
    """
    no_place = len(sensor.landmark) == 0 or sensor.carry is not None
    if no_place or np.shape(sensor.free.mean)[0] > 0:
        reason = f"expected one that measures points, got {sensor.name}"
        raise InvalidField("sensor", reason, owner="seen_points")
    z = jnp.where(scan.valid[:, None], scan.z, 0.0)
    origin, unmeasured = jnp.zeros(3, z.dtype), jnp.zeros(0, z.dtype)

    def point(z: Array) -> Array:
        return sensor.position(sensor.invert(origin, z, unmeasured))

    jacobian = jax.vmap(jax.jacfwd(point))(z)
    covs = jacobian @ jax.vmap(sensor.noise_cov)(z) @ jacobian.transpose(0, 2, 1)
    valid = scan.valid[:, None, None]
    points = jnp.where(scan.valid[:, None], jax.vmap(point)(z), 0.0)
    return points, jnp.where(valid, covs, jnp.eye(2, dtype=z.dtype)[None])


def relocalize(
    points: Array,
    cov: Array,
    alive: Array,
    seen: Array,
    seen_covs: Array,
    valid: Array,
    *,
    probability: float = 0.99,
    least: int = 4,
    margin: int = 2,
    pairs: int = 8,
    candidates: int = 512,
) -> _Relocalization:
    """The pose of a scan in a map without a prior, by distances between pairs of points.

    The search is `match_points`. A hypothesis is a different pose if it shares fewer than two pairs
    with the best hypothesis, for two pairs fix a pose. The scan is ambiguous if such a hypothesis
    explains almost as many measurements, as in a symmetric map. Errors common to the whole map (of
    its origin) do not matter, because the cross-covariances are used.

    Args:
        points: (N, 2) the map [m].
        cov: (2N, 2N) its joint covariance in coordinates [m²].
        alive: (N,) bool.
        seen: (M, 2) the scan's points in the robot's frame [m], from `seen_points`.
        seen_covs: (M, 2, 2) their covariances, independent of each other.
        valid: (M,) bool.
        probability: of each chi-square test.
        least: measurements that must be explained, at least 3.
        margin: least number of matches more than at any other pose.
        pairs: number of pairs of measurements, long ones, whose distances are searched for.
        candidates: number of best agreeing pairs of landmarks tried with each of them; where there
            are more, `exhausted` is set.
    Raises:
        ValueError: on shapes that do not fit, a probability not between 0 and 1, least below 3,
            or margin, pairs or candidates below 1.
    """
    points, cov, alive = jnp.asarray(points), jnp.asarray(cov), jnp.asarray(alive)
    seen, seen_covs, valid = jnp.asarray(seen), jnp.asarray(seen_covs), jnp.asarray(valid)
    n, m = np.shape(points)[0], np.shape(seen)[0]
    arrays = (
        ("points", points, (n, 2)),
        ("cov", cov, (2 * n, 2 * n)),
        ("alive", alive, (n,)),
        ("seen", seen, (m, 2)),
        ("seen_covs", seen_covs, (m, 2, 2)),
        ("valid", valid, (m,)),
    )
    with refusals_of("relocalize"):
        for argument, value, shape in arrays:
            require(argument, value, array_of(*shape))
        check_search(least, margin, probability, pairs, candidates)
    if n < 2 or m < 2:
        none, dtype = jnp.zeros((), jnp.int32), jnp.result_type(points)
        match = GeometricMatch(
            pose=jnp.zeros(3, dtype),
            slot=jnp.full(m, -1, jnp.int32),
            explained=none,
            distance=jnp.zeros((), dtype),
            runner_up=none,
            exhausted=jnp.asarray(False),
        )
    else:
        seen_cov = jnp.zeros((m, 2, m, 2), seen.dtype)
        seen_cov = seen_cov.at[jnp.arange(m), :, jnp.arange(m)].set(seen_covs)
        cross_cov = jnp.zeros((m, 2, n, 2), seen.dtype)
        allowed = valid[:, None] & alive[None]
        sets = PointSets(seen, points, seen_cov, cov.reshape(n, 2, n, 2), cross_cov, allowed)
        match = match_points(sets, search_limits(m, probability, pairs, candidates))
    ok = (match.explained >= least) & (match.explained - match.runner_up >= margin)
    return _Relocalization(ok=ok, **match._asdict())


def points_of_map(
    joint: Joint, chart: Chart, *, square_root: bool = False
) -> tuple[Float[Array, "N 2"], Float[Array, "2*N 2*N"], Bool[Array, "N"]]:
    """The points of a map, their joint covariance in coordinates, and the mask of the alive ones.

    Raises ValueError unless the landmarks are points.
    """
    with refusals_of("points_of_map"):
        check_point_map(joint)
    cov = cov_of_coordinates(joint, chart, square_root=square_root)
    return joint.landmarks, cov[3:, 3:], joint.alive


def forget_pose(
    joint: Joint, chart: Chart, pose_cov: ArrayLike, *, square_root: bool = False
) -> Joint:
    """The state with the robot's pose unknown and its map unchanged.

    In coordinates P_RR ← pose_cov, P_RM ← 0, and P_MM does not change: the pose is marginalized
    out and given an independent prior, at the previous estimate.

    Raises ValueError on landmarks other than points, a linearizer with a memory, or a pose_cov
    that is no covariance.
    """
    with refusals_of("forget_pose"):
        check_point_map(joint)
        require("pose_cov", pose_cov, covariance(3))
    cov = cov_of_coordinates(joint, chart, square_root=square_root)
    cov = cov.at[:3].set(0.0).at[:, :3].set(0.0)
    cov = cov.at[:3, :3].set(jnp.asarray(pose_cov, cov.dtype))
    return with_cov_of_coordinates(joint, chart, cov, square_root=square_root)


def replace_pose(
    joint: Joint,
    chart: Chart,
    slot: Int[Array, "M"],
    seen: Array,
    seen_covs: Array,
    *,
    square_root: bool = False,
) -> Joint:
    """The state with the robot's pose replaced by the pose that aligns its scan with the map.

    With r = T z - m over the pairs, J = ∂r/∂T, Σ = cov(r) = R Z Rᵀ + P_mm, N = (Jᵀ Σ⁻¹ J)⁻¹ and
    A = Σ⁻¹ - Σ⁻¹ J N Jᵀ Σ⁻¹, T the generalized least squares: P_TT = N, P_TM = N Jᵀ Σ⁻¹ P_mM,
    M ← M + P_Mm A r and P_MM ← P_MM - P_Mm A P_mM. So it is the limit of an update from an infinite
    covariance of the pose, linearized at the result. Do not use the scan in an update again.
    Nothing happens with fewer than two pairs, or where the pose is not determined.

    Args:
        slot: (M,) landmark of each measurement, -1 for none, from `relocalize`.
        seen, seen_covs: the scan in the robot's frame, from `seen_points`.
    Raises:
        ValueError: as `forget_pose`, or on shapes that do not fit.
    """
    m, capacity = np.shape(slot)[0], joint.landmarks.shape[0]
    with refusals_of("replace_pose"):
        check_point_map(joint)
        require("seen", seen, array_of(m, 2))
        require("seen_covs", seen_covs, array_of(m, 2, 2))
    cov = cov_of_coordinates(joint, chart, square_root=square_root)
    seen_cov = jnp.zeros((m, 2, m, 2), cov.dtype)
    seen_cov = seen_cov.at[jnp.arange(m), :, jnp.arange(m)].set(seen_covs)
    map_cov = cov[3:, 3:].reshape(capacity, 2, capacity, 2)
    cross_cov = jnp.zeros((m, 2, capacity, 2), cov.dtype)
    allowed = (slot >= 0)[:, None] & joint.alive[None]
    slot = jnp.where((slot >= 0) & joint.alive[jnp.maximum(slot, 0)], slot, -1)
    points = PointSets(seen, joint.landmarks, seen_cov, map_cov, cross_cov, allowed)
    alignment = align_points(points, slot)
    paired = (slot >= 0)[:, None]
    rows = jnp.where(paired[:, :, None], map_cov[jnp.maximum(slot, 0)].reshape(m, 2, -1), 0.0)
    # With Σ = L Lᵀ: L⁻¹ P_mM, L⁻¹ J and L⁻¹ r.
    # (m, 2, N·2) -> (2m, 2N), as the rows of Σ.
    rows = linalg.solve_lower(alignment.factor, rows.reshape(2 * m, -1))
    by_pose = linalg.solve_lower(alignment.factor, alignment.jacobian)
    white = linalg.solve_lower(alignment.factor, alignment.residual)
    normal = by_pose.T @ by_pose
    ok = alignment.regular & ((slot >= 0).sum() >= 2) & linalg.cholesky(normal)[1]
    pose_cov = linalg.inverse(jnp.where(ok, normal, jnp.eye(3, dtype=cov.dtype)))
    with_map = pose_cov @ (by_pose.T @ rows)
    # L⁻¹ P_mM without the part that the pose explains: Lᵀ A P_mM.
    left = rows - by_pose @ with_map
    landmarks = joint.landmarks + (left.T @ white).reshape(capacity, 2)
    after = cov.at[:3, :3].set(linalg.symmetrize(pose_cov))
    after = after.at[3:, 3:].set(cov[3:, 3:] - linalg.symmetrize(rows.T @ left))
    after = after.at[:3, 3:].set(with_map).at[3:, :3].set(with_map.T)
    moved = joint._replace(
        pose=alignment.pose, landmarks=jnp.where(joint.alive[:, None], landmarks, 0.0)
    )
    moved = with_cov_of_coordinates(moved, chart, after, square_root=square_root)
    aligned: Joint = jax.tree.map(lambda a, b: jnp.where(ok, a, b), moved, joint)
    return aligned
