"""A sensor of one polar coordinate of a point landmark: `RangeOnly` and `BearingOnly`."""

import jax.numpy as jnp
from jax import Array

from jaxslam.core.record import set_field
from jaxslam.math import se2
from jaxslam.math.arrays import (
    InvertJacobians,
    Landmark,
    Measurement,
    ObserveJacobians,
    Pose,
    Unmeasured,
)
from jaxslam.protocols import Sensor
from jaxslam.sensors.partial.prior import free_parameters


class PolarCoordinate(Sensor):
    """The sensor of one row of z = polar(to_frame(pose ∘ mount, l)), the other row being free.

    A subclass has a field `free`, mean (1,) and covariance (1, 1) of the other row.
    """

    _own: slice
    _other: slice

    def __post_init__(self) -> None:
        set_field(self, "free", free_parameters(type(self).__name__, self.free, 1))
        super().__post_init__()

    def _polar(self, z: Measurement, s: Unmeasured) -> Array:
        return jnp.concatenate([s, z] if self._own.start else [z, s])

    def observe(self, pose: Pose, landmark: Landmark) -> Measurement:
        return se2.polar_in_frame(self.frame(pose), landmark)[self._own]

    def invert(self, pose: Pose, z: Measurement, s: Unmeasured) -> Landmark:
        return se2.from_frame(self.frame(pose), se2.rectangular(self._polar(z, s)))

    def observe_jacobians(self, pose: Pose, landmark: Landmark) -> ObserveJacobians:
        frame = self.frame(pose)
        by_frame, by_point = se2.to_frame_jacobians(frame, landmark)
        outer = se2.polar_jacobians(se2.to_frame(frame, landmark))[0][self._own]
        return outer @ by_frame @ self.frame_jacobian(pose), outer @ by_point

    def invert_jacobians(self, pose: Pose, z: Measurement, s: Unmeasured) -> InvertJacobians:
        seen = self._polar(z, s)
        by_frame, by_point = se2.from_frame_jacobians(self.frame(pose), se2.rectangular(seen))
        by_polar = by_point @ se2.rectangular_jacobians(seen)[0]
        return (
            by_frame @ self.frame_jacobian(pose),
            by_polar[:, self._own],
            by_polar[:, self._other],
        )
