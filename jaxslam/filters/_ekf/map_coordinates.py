"""A `Joint` in map coordinates (x, y, θ, l), whatever the filter's chart: estimate, covariance, and
retraction by errors; inverse-depth landmarks, which become points once that is accurate.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxslam.core import slots
from jaxslam.core._record import record
from jaxslam.core.protocols import Chart, Sensor
from jaxslam.core.slots import Joint
from jaxslam.core.types import Estimate
from jaxslam.filters._ekf.linear_system import Transition, moved_cov
from jaxslam.math import _linalg as linalg
from jaxslam.math._arrays import Landmark, Measurement, Point, Pose
from jaxslam.math._xla import where_any
from jaxslam.sensors._suite import Wrapped


class ToPoints(NamedTuple):
    """Landmarks reduced to points; `info.extra["points"]`."""

    reduced: Bool[Array, "N"]
    """slots whose landmark became a point in this step"""

    def counts(self) -> dict[str, Array]:
        """The counts of a campaign."""
        return {"reduced": self.reduced}


def _measured_points(sensor: Sensor, reduced: Bool[Array, ""] | None) -> Sensor:
    """The sensor for a landmark that may be a point (x, y, padding); None: no landmark is one."""
    if sensor.reduced is None or reduced is None:
        return sensor
    return _MaybePoint(sensor, sensor.reduced.sensor, reduced)


@record
class _MaybePoint(Wrapped):
    """A sensor of a landmark that may be a point (x, y, padding)."""

    sensor: Sensor
    as_points: Sensor
    is_point: Bool[Array, ""]

    def observe(self, pose: Pose, landmark: Landmark) -> Measurement:
        as_point = self.as_points.observe(pose, landmark[:2])
        return jnp.where(self.is_point, as_point, self.sensor.observe(pose, landmark))

    def position(self, landmark: Landmark) -> Point:
        return jnp.where(self.is_point, landmark[:2], self.sensor.position(landmark))


def at_slot(sensor: Sensor, joint: Joint, slot: Int[Array, ""]) -> Sensor:
    """The sensor for the landmark of a slot () of the map."""
    return sensor if joint.reduced is None else _measured_points(sensor, joint.reduced[slot])


def reduce_where_ready(
    joint: Joint, sensor: Sensor, square_root: bool
) -> tuple[Joint, Bool[Array, "N"], Transition]:
    """The map with all landmarks reduced that may become points, which, and the transition."""
    assert sensor.reduced is not None
    slot = jnp.arange(joint.landmarks.shape[0])
    covs = jax.vmap(partial(slots.local_cov, joint, square_root=square_root))(slot)[:, 3:, 3:]
    linear = jax.vmap(sensor.reduced.ready, (None, 0, 0))(joint.pose, joint.landmarks, covs)
    which: jax.Array = linear & joint.alive & ~joint.reduced

    def reduce_ready(joint: Joint) -> Joint:
        return reduce(joint, which, sensor, square_root)

    after = where_any(which.any(), reduce_ready, lambda joint: joint, joint)
    return after, which, reduction(joint, which, sensor)


def reduce(joint: Joint, which: Bool[Array, "N"], sensor: Sensor, square_root: bool) -> Joint:
    """The map with the landmarks of the slots `which` reduced to points.

    With J = ∂position/∂l (2, L), l ← position(l) and, of all errors, e_l ← J e_l, in rows and
    columns of P. The other L - 2 coordinates become padding. In a chart with identity
    `Basis.landmark` (None), J is the derivative by e_l at a fixed pose error.
    """
    size = joint.landmarks.shape[1]
    points = jax.vmap(sensor.position)(joint.landmarks)
    turned = reduction(joint, which, sensor).turn
    # Unit variance in place of the coordinates that are dropped: the invariant of padding.
    padding = jnp.concatenate(
        [jnp.zeros(3, bool), (which[:, None] & (jnp.arange(size) >= 2)[None, :]).reshape(-1)]
    )
    unit = jnp.diag(padding.astype(points.dtype))
    # U = diag(padding) = U Uᵀ, so [J X, U] is a root of J P Jᵀ + U.
    if square_root:
        cov = linalg.triangular_root(jnp.concatenate([turned(joint.cov), unit], axis=1))
    else:
        cov = linalg.symmetrize(turned(turned(joint.cov).T)) + unit
    # Exactly the same for a run that gets here only because of another run of the batch.
    cov = jnp.where(which.any(), cov, joint.cov)
    landmarks = jnp.pad(points, [(0, 0), (0, size - 2)])
    return joint._replace(
        landmarks=jnp.where(which[:, None], landmarks, joint.landmarks),
        cov=cov,
        reduced=joint.reduced | which,
    )


def reduction(joint: Joint, which: Bool[Array, "N"], sensor: Sensor) -> Transition:
    """The transition of the errors in `reduce`."""
    capacity, size = joint.landmarks.shape
    by_landmark = jax.vmap(jax.jacfwd(sensor.position))(joint.landmarks)
    still = jnp.eye(3, dtype=by_landmark.dtype)
    # Zero rows below J (2, L) make it square: the rows of the coordinates that are dropped.
    freed = jnp.pad(by_landmark, [(0, 0), (0, size - 2), (0, 0)])
    gain = jnp.where(which[:, None, None], freed, jnp.eye(size, dtype=still.dtype))
    return Transition(still, jnp.zeros((capacity, size, 3), still.dtype), gain, still, None)


def estimate_of(
    joint: Joint, sensor: Sensor, chart: Chart, *, square_root: bool = False
) -> Estimate:
    """Means and marginal covariances in map coordinates, for any chart and landmark parameters."""
    capacity, size = joint.landmarks.shape
    cov = joint.cov @ joint.cov.T if square_root else joint.cov
    pose_cov = cov[:3, :3]
    slot = jnp.arange(capacity)
    # P of landmarks by slot and entry, (N, L, N, L): its diagonal blocks.
    own_covs = cov[3:, 3:].reshape(capacity, size, capacity, size)[slot, :, slot]
    with_pose = cov[3:, :3].reshape(capacity, size, 3)

    def point(
        landmark: Float[Array, "L"],
        cov: Float[Array, "L L"],
        by_robot: Float[Array, "L 3"],
        reduced: PyTree,
    ) -> tuple[Float[Array, "2"], Float[Array, "2 2"]]:
        position = _measured_points(sensor, reduced).position
        by_landmark = jax.jacfwd(position)(landmark)
        if chart.basis is not None:
            basis = chart.basis(joint.pose, landmark)
            if basis.landmark is not None:
                cov, by_robot = basis.landmark @ cov @ basis.landmark.T, basis.landmark @ by_robot
            # [c E_l] P [c E_l]ᵀ of pose and landmark: the mixed terms, then c P_RR cᵀ.
            cross = basis.cross @ by_robot.T
            cov = cov + cross + cross.T
            cov = cov + basis.cross @ pose_cov @ basis.cross.T
        return position(landmark), by_landmark @ cov @ by_landmark.T

    points, point_covs = jax.vmap(point)(joint.landmarks, own_covs, with_pose, joint.reduced)
    if chart.basis is not None:
        basis = chart.pose_basis(joint.pose)
        pose_cov = basis @ pose_cov @ basis.T
    # The position of a landmark of zeros may be anything (of an inverse depth, 1000 km away).
    unit = jnp.eye(2, dtype=point_covs.dtype)[None]
    return Estimate(
        pose=joint.pose,
        pose_cov=pose_cov,
        points=jnp.where(joint.alive[:, None], points, 0.0),
        point_covs=jnp.where(joint.alive[:, None, None], point_covs, unit),
        alive=joint.alive,
        tag=joint.tag,
    )


def cov_of_coordinates(
    joint: Joint, chart: Chart, *, square_root: bool = False
) -> Float[Array, "D D"]:
    """The covariance E P Eᵀ (D, D) of coordinates, E the chart's basis at the estimate; O(N²)."""
    cov = joint.cov @ joint.cov.T if square_root else joint.cov
    if chart.basis is None:
        return cov
    basis = jax.vmap(chart.basis, in_axes=(None, 0))(joint.pose, joint.landmarks)
    alive = joint.alive[:, None, None]
    # Padding stays as it is, whatever the basis at a landmark of zeros.
    cross = jnp.where(alive, basis.cross, 0.0)
    landmark = basis.landmark
    if landmark is not None:
        landmark = jnp.where(alive, landmark, jnp.eye(landmark.shape[-1], dtype=cov.dtype)[None])
    return moved_cov(cov, Transition(basis.pose[0], cross, landmark, basis.pose[0], None), None)


def with_cov_of_coordinates(
    joint: Joint, chart: Chart, cov: Float[Array, "D D"], *, square_root: bool = False
) -> Joint:
    """The state with covariance cov (D, D) in map coordinates, at the same estimate."""
    if chart.basis is not None:
        basis = jax.vmap(chart.basis, in_axes=(None, 0))(joint.pose, joint.landmarks)
        alive = joint.alive[:, None, None]
        undo = linalg.inverse(basis.pose[0])
        # E⁻¹ = [E_x⁻¹ 0; -E_l⁻¹ c E_x⁻¹, E_l⁻¹].
        cross, landmark = -basis.cross @ undo, None
        if basis.landmark is not None:
            landmark = jax.vmap(linalg.inverse)(basis.landmark)
            cross = landmark @ cross
            landmark = jnp.where(alive, landmark, jnp.eye(cross.shape[1], dtype=cov.dtype)[None])
        cross = jnp.where(alive, cross, 0.0)
        cov = moved_cov(cov, Transition(undo, cross, landmark, undo, None), None)
    return joint._replace(cov=linalg.root_psd(cov) if square_root else cov)


def retract_map(
    chart: Chart, joint: Joint, xi: Float[Array, "D"]
) -> tuple[Float[Array, "3"], Float[Array, "N L"]]:
    """Pose (3,) and landmarks (N, L) moved by errors ξ (D,)."""
    over_landmarks = jax.vmap(chart.retract, in_axes=(None, 0, None, 0))
    poses, landmarks = over_landmarks(
        joint.pose, joint.landmarks, xi[:3], xi[3:].reshape(joint.landmarks.shape)
    )
    # dx alone moves a dead landmark too in some charts: the direction of a ray turns with the map.
    return poses[0], jnp.where(joint.alive[:, None], landmarks, 0.0)
