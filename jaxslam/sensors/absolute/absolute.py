"""Sensors of the robot's own state in the map, without a landmark."""

import jax.numpy as jnp

from jaxslam.math.arrays import (
    InvertJacobians,
    Landmark,
    Measurement,
    ObserveJacobians,
    Point,
    Pose,
    Unmeasured,
)
from jaxslam.protocols import Sensor


class Absolute(Sensor):
    """A sensor z = rows of pose ∘ mount, with L = 0: invert, embed and position are not used."""

    landmark = ()
    rows: slice

    def observe(self, pose: Pose, landmark: Landmark) -> Measurement:
        return self.frame(pose)[self.rows]

    def observe_jacobians(self, pose: Pose, landmark: Landmark) -> ObserveJacobians:
        by_pose = self.frame_jacobian(pose)[self.rows]
        return by_pose, by_pose[:, :0]

    def invert(self, pose: Pose, z: Measurement, s: Unmeasured) -> Landmark:
        return jnp.zeros(0, pose.dtype)

    def invert_jacobians(self, pose: Pose, z: Measurement, s: Unmeasured) -> InvertJacobians:
        none = jnp.zeros((0, 3), pose.dtype)
        return none, none[:, : len(self.measurements)], none[:, :0]

    def position(self, landmark: Landmark) -> Point:
        return jnp.zeros(2, landmark.dtype)

    def embed(self, pose: Pose, point: Point) -> Landmark:
        return jnp.zeros(0, pose.dtype)
