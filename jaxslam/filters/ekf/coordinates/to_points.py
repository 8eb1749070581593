"""Reduction of inverse-depth landmarks to points, once first-order linearization is accurate."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jaxslam import slots
from jaxslam.core.record import record
from jaxslam.filters.ekf.coordinates.linear_system import Transition
from jaxslam.math import linalg
from jaxslam.math.arrays import Landmark, Measurement, Point, Pose
from jaxslam.math.xla import where_any
from jaxslam.protocols import Sensor
from jaxslam.sensors.wrapped import Wrapped
from jaxslam.slots import Joint


class ToPoints(NamedTuple):
    """Landmarks reduced to points; `info.extra["points"]`."""

    reduced: Bool[Array, "N"]
    """slots whose landmark became a point in this step"""

    def counts(self) -> dict[str, Array]:
        """What a campaign counts."""
        return {"reduced": self.reduced}


def seen_as(sensor: Sensor, reduced: Bool[Array, ""] | None) -> Sensor:
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
    return sensor if joint.reduced is None else seen_as(sensor, joint.reduced[slot])


def reduced_where_ready(
    joint: Joint, sensor: Sensor, square_root: bool
) -> tuple[Joint, Bool[Array, "N"], Transition]:
    """The map with all landmarks reduced that may become points, which, and the transition."""
    which = ready(joint, sensor, square_root)

    def reduced(joint: Joint) -> Joint:
        return reduce(joint, which, sensor, square_root)

    after = where_any(which.any(), reduced, lambda joint: joint, joint)
    return after, which, reduction(joint, which, sensor)


def ready(joint: Joint, sensor: Sensor, square_root: bool) -> Bool[Array, "N"]:
    """Which landmarks may become points now."""
    assert sensor.reduced is not None
    every = jnp.arange(joint.landmarks.shape[0])
    covs = jax.vmap(partial(slots.local_cov, joint, square_root=square_root))(every)[:, 3:, 3:]
    linear = jax.vmap(sensor.reduced.ready, (None, 0, 0))(joint.pose, joint.landmarks, covs)
    good: jax.Array = linear & joint.alive & ~joint.reduced
    return good


def reduce(joint: Joint, which: Bool[Array, "N"], sensor: Sensor, square_root: bool) -> Joint:
    """The map with the landmarks of the slots `which` reduced to points.

    With J = ∂position/∂l (2, L), l ← position(l) and, of all errors, e_l ← J e_l, in rows and
    columns of P. The other L - 2 coordinates become padding. In a chart with identity
    `Basis.landmark` (None), J is the derivative by e_l at a fixed pose error.
    """
    size = joint.landmarks.shape[1]
    points = jax.vmap(sensor.position)(joint.landmarks)
    turned = reduction(joint, which, sensor).turn
    padding = jnp.concatenate(
        [jnp.zeros(3, bool), (which[:, None] & (jnp.arange(size) >= 2)[None, :]).reshape(-1)]
    )
    unit = jnp.diag(padding.astype(points.dtype))
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
    freed = jnp.pad(by_landmark, [(0, 0), (0, size - 2), (0, 0)])
    gain = jnp.where(which[:, None, None], freed, jnp.eye(size, dtype=still.dtype))
    return Transition(still, jnp.zeros((capacity, size, 3), still.dtype), gain, still, None)
