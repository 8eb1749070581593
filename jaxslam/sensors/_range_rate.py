"""Range, bearing and range rate of a point landmark, from a Doppler radar or sonar."""

import jax
import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from jaxslam.core._record import record
from jaxslam.core.noise import NoiseCov
from jaxslam.core.protocols import Sensor
from jaxslam.math import se2
from jaxslam.math._arrays import (
    InvertJacobians,
    Landmark,
    Measurement,
    ObserveJacobians,
    Robot,
    Unmeasured,
)


class PolarWithRate(Sensor):
    """The base of sensors of range, bearing and a rate, whose landmarks are those of the first two.

    The rate tells of the robot, and not where a landmark is.
    """

    def invert(self, pose: Robot, z: Measurement, s: Unmeasured) -> Landmark:
        return se2.from_frame(self.frame(pose), se2.rectangular(z[:2]))

    def invert_jacobians(self, pose: Robot, z: Measurement, s: Unmeasured) -> InvertJacobians:
        by_frame, by_point = se2.from_frame_jacobians(self.frame(pose), se2.rectangular(z[:2]))
        (inner,) = se2.rectangular_jacobians(z[:2])
        by_pose = by_frame @ self.frame_jacobian(pose)
        by_robot = jnp.pad(by_pose, [(0, 0), (0, len(self.robot))])
        by_z = jnp.pad(by_point @ inner, [(0, 0), (0, 1)])
        return by_robot, by_z, jnp.zeros((2, 0), pose.dtype)


@record
class RangeRate(PolarWithRate):
    """The Doppler sensor of point landmarks at rest.

    z = (range r [m], bearing φ [rad], range rate ṙ [m/s]) of l = (x, y): the first two as of
    `RangeBearing`, in the frame S = pose ∘ mount, and the rate at which the range changes. With the
    robot's velocity v along its axis and turn rate ω, the sensor at (a, b, γ) on the robot moves
    with (v - ωb, ωa) in the robot's axes, and

        ṙ = -(v - ωb) cos(φ + γ) - ωa sin(φ + γ).

    It asks for v of the motion model's state, and, with a mount, for ω. invert is that of
    `RangeBearing`: the range rate tells of the robot, and not where a landmark is, so that of a
    landmark's first measurement is not used. Exactly at the sensor, z has zero derivative by l.
    """

    noise_cov: NoiseCov
    """(3, 3) covariance of z, or a function of z."""
    mount: ArrayLike | None = None
    """(3,) = (a, b, γ), pose of the sensor on the robot, Solà's S"""
    measurements = ("range [m]", "bearing [rad]", "range_rate [m/s]")

    @property
    def robot(self) -> tuple[str, ...]:  # type: ignore[override]
        return ("v [m/s]",) if self.mount is None else ("v [m/s]", "omega [rad/s]")

    @property
    def equations(self) -> str:  # type: ignore[override]
        mounted = self.mount is not None
        ahead, left = ("(v - omega*b)", "omega*a") if mounted else ("v", "0")
        return "\n".join(
            ["a, b, gamma = mount"] * mounted
            + [
                "range = sqrt((l_x - x_s)**2 + (l_y - y_s)**2) + n_range",
                "seen = atan2(l_y - y_s, l_x - x_s) - theta_s",
                "bearing = wrap(seen + n_bearing)",
                f"range_rate = -{ahead}*cos(seen{' + gamma' * mounted})"
                + f" - {left}*sin(seen + gamma)" * mounted
                + " + n_range_rate",
            ]
        )

    def observe(self, pose: Robot, landmark: Landmark) -> Measurement:
        seen = se2.polar_in_frame(self.frame(pose), landmark)
        return jnp.concatenate([seen, self._rate(pose[3:], seen[1])[None]])

    def observe_jacobians(self, pose: Robot, landmark: Landmark) -> ObserveJacobians:
        frame = self.frame(pose)
        by_frame, by_point = se2.to_frame_jacobians(frame, landmark)
        (outer,) = se2.polar_jacobians(se2.to_frame(frame, landmark))
        by_pose, by_landmark = outer @ by_frame @ self.frame_jacobian(pose), outer @ by_point
        phi = se2.polar_in_frame(frame, landmark)[1]
        by_velocity, by_bearing = jax.grad(self._rate, argnums=(0, 1))(pose[3:], phi)
        # (3, 3 + k): the range rate depends on the pose through the bearing alone.
        rows = jnp.concatenate([by_pose, by_bearing * by_pose[1:]])
        velocity = jnp.zeros((3, len(by_velocity)), pose.dtype).at[2].set(by_velocity)
        by_robot = jnp.concatenate([rows, velocity], axis=1)
        return by_robot, jnp.concatenate([by_landmark, by_bearing * by_landmark[1:]])

    def _rate(self, velocity: Array, phi: Array) -> Array:
        """The range rate () at a bearing (), of velocity (v,), or (v, ω)."""
        if self.mount is None:
            return -velocity[0] * jnp.cos(phi)
        a, b, gamma = jnp.asarray(self.mount, velocity.dtype)
        v, omega = velocity
        direction = phi + gamma
        return -(v - omega * b) * jnp.cos(direction) - omega * a * jnp.sin(direction)
