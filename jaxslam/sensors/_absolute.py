"""Sensors of the robot's state without a landmark: of its pose in the map, or of its velocities."""

import jax.numpy as jnp
from numpy.typing import ArrayLike

from jaxslam.core._record import record
from jaxslam.core.noise import NoiseCov
from jaxslam.core.protocols import Sensor
from jaxslam.math._arrays import (
    InvertJacobians,
    Landmark,
    Measurement,
    ObserveJacobians,
    Point,
    Pose,
    Robot,
    Unmeasured,
)


class Absolute(Sensor):
    """A sensor z = rows of pose ∘ mount, with L = 0: invert, embed and position are not used."""

    landmark = ()
    rows: slice

    def observe(self, pose: Robot, landmark: Landmark) -> Measurement:
        return self.frame(pose)[self.rows]

    def observe_jacobians(self, pose: Robot, landmark: Landmark) -> ObserveJacobians:
        by_pose = self.frame_jacobian(pose)[self.rows]
        # (Z, 0): there is no landmark to differentiate by.
        return by_pose, by_pose[:, :0]

    def invert(self, pose: Robot, z: Measurement, s: Unmeasured) -> Landmark:
        return jnp.zeros(0, pose.dtype)

    def invert_jacobians(self, pose: Robot, z: Measurement, s: Unmeasured) -> InvertJacobians:
        none = jnp.zeros((0, len(pose)), pose.dtype)
        return none, jnp.zeros((0, len(self.measurements)), pose.dtype), none[:, :0]

    def position(self, landmark: Landmark) -> Point:
        return jnp.zeros(2, landmark.dtype)

    def embed(self, pose: Pose, point: Point) -> Landmark:
        return jnp.zeros(0, pose.dtype)


@record
class Compass(Absolute):
    """The compass, an absolute sensor of the heading.

    z = (heading [rad]) = wrap(θ + θ_mount), counter-clockwise from the map's x-axis.

    An absolute sensor (Williams' list of observations): there is no landmark, L = 0, and `invert`,
    `embed` and `position` (zeros) are not used.
    """

    noise_cov: NoiseCov
    """(1, 1) covariance of the heading, or a function of z."""
    mount: ArrayLike | None = None
    """(3,) pose of the sensor on the robot; only its angle matters."""
    measurements = ("heading [rad]",)
    equations = "heading = wrap(theta_s + n_heading)"
    rows = slice(2, 3)


@record
class PositionFix(Absolute):
    """The position fix, an absolute sensor of the antenna's position.

    z = (x [m], y [m]) of the antenna: t + R(θ) t_mount, the translation of pose ∘ mount.

    An absolute sensor (GPS in Williams' list of observations): there is no landmark, L = 0, and
    `invert`, `embed` and `position` (zeros) are not used.
    """

    noise_cov: NoiseCov
    """(2, 2) covariance of z, or a function of z."""
    mount: ArrayLike | None = None
    """(3,) pose of the antenna on the robot; its angle does not matter."""
    measurements = ("x [m]", "y [m]")
    equations = "x = x_s + n_x\ny = y_s + n_y"
    rows = slice(0, 2)


class _OneNumber(Absolute):
    """An absolute sensor of the one number of the robot that it asks for."""

    def observe(self, pose: Robot, landmark: Landmark) -> Measurement:
        return pose[3:]

    def observe_jacobians(self, pose: Robot, landmark: Landmark) -> ObserveJacobians:
        by_robot = jnp.zeros((1, 4), pose.dtype).at[0, 3].set(1)
        return by_robot, by_robot[:, :0]


@record
class Speed(_OneNumber):
    """The speedometer, an absolute sensor of the robot's velocity.

    z = (v [m/s]), the number of that name in the state of the motion model, as of
    `motion.ConstantVelocity`; L = 0.
    """

    noise_cov: NoiseCov
    """(1, 1) covariance of z, or a function of z."""
    measurements = ("v [m/s]",)
    robot = ("v [m/s]",)
    equations = "v = v + n_v"


@record
class TurnRate(_OneNumber):
    """The gyroscope, an absolute sensor of the robot's turn rate.

    z = (omega [rad/s]), the number of that name in the state of the motion model, as of
    `motion.ConstantVelocity`; L = 0. Of a gyroscope whose bias is to be estimated, and which is
    part of the odometry, see `motion.BiasedOdometry`.
    """

    noise_cov: NoiseCov
    """(1, 1) covariance of z, or a function of z."""
    measurements = ("omega [rad/s]",)
    robot = ("omega [rad/s]",)
    equations = "omega = omega + n_omega"
