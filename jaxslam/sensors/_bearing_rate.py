"""Range, bearing and bearing rate of a point landmark, as of optical flow with depth."""

import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from jaxslam.core._record import record
from jaxslam.core.noise import NoiseCov
from jaxslam.math import se2
from jaxslam.math._arrays import Landmark, Measurement, ObserveJacobians, Robot
from jaxslam.sensors._range_rate import PolarWithRate


@record
class BearingRate(PolarWithRate):
    """The sensor of point landmarks at rest that also measures how fast their bearings change.

    z = (range r [m], bearing φ [rad], bearing rate φ̇ [rad/s]) of l = (x, y): the first two as of
    `RangeBearing`, in the frame S = pose ∘ mount, and the rate at which the bearing changes, as the
    optical flow of a camera. With the robot's velocity v along its axis and turn rate ω, the sensor
    at (a, b, γ) on the robot moves with (v - ωb, ωa) in the robot's axes and turns with it:

        φ̇ = ((v - ωb) sin(φ + γ) - ωa cos(φ + γ)) / r - ω.

    It asks for v and ω of the motion model's state: far landmarks tell ω, near ones v. invert is
    that of `RangeBearing`: the rate of a landmark's first measurement is not used. Exactly at the
    sensor φ̇ = -ω, and z has zero derivative by l.
    """

    noise_cov: NoiseCov
    """(3, 3) covariance of z, or a function of z."""
    mount: ArrayLike | None = None
    """(3,) = (a, b, γ), pose of the sensor on the robot, Solà's S"""
    measurements = ("range [m]", "bearing [rad]", "bearing_rate [rad/s]")
    robot = ("v [m/s]", "omega [rad/s]")

    @property
    def equations(self) -> str:  # type: ignore[override]
        return "\n".join(
            [
                "a, b, gamma = mount" if self.mount is not None else "a, b, gamma = 0, 0, 0",
                "r = sqrt((l_x - x_s)**2 + (l_y - y_s)**2)",
                "seen = atan2(l_y - y_s, l_x - x_s) - theta_s",
                "range = r + n_range",
                "bearing = wrap(seen + n_bearing)",
                "across = (v - omega*b)*sin(seen + gamma) - omega*a*cos(seen + gamma)",
                "bearing_rate = across/r - omega + n_bearing_rate",
            ]
        )

    def observe(self, pose: Robot, landmark: Landmark) -> Measurement:
        frame = self.frame(pose)
        p, per_square = _inverse_square(se2.to_frame(frame, landmark))
        u_x, u_y = self._by_velocity(pose) @ pose[3:]
        rate = (p[1] * u_x - p[0] * u_y) * per_square - pose[4]
        return jnp.concatenate([se2.polar_in_frame(frame, landmark), rate[None]])

    def observe_jacobians(self, pose: Robot, landmark: Landmark) -> ObserveJacobians:
        frame = self.frame(pose)
        seen = se2.to_frame(frame, landmark)
        by_frame, by_point = se2.to_frame_jacobians(frame, landmark)
        p, per_square = _inverse_square(seen)
        by_velocity = self._by_velocity(pose)
        u_x, u_y = by_velocity @ pose[3:]
        flow = (p[1] * u_x - p[0] * u_y) * per_square
        # Of (p_y u_x - p_x u_y)/r², whose r² depends on p, too; (2,).
        rate_by_p = (jnp.stack([-u_y, u_x]) - 2 * flow * p) * per_square
        by_p = jnp.concatenate([se2.polar_jacobians(seen)[0], rate_by_p[None]])
        across = (p[1] * by_velocity[0] - p[0] * by_velocity[1]) * per_square
        rate = across - jnp.array([0, 1], pose.dtype)
        velocity = jnp.zeros((3, 2), pose.dtype).at[2].set(rate)
        by_pose = by_p @ by_frame @ self.frame_jacobian(pose)
        return jnp.concatenate([by_pose, velocity], axis=1), by_p @ by_point

    def _by_velocity(self, robot: Robot) -> Array:
        """(2, 2) the derivative of the sensor's velocity u in its own axes by (v, ω)."""
        if self.mount is None:
            return jnp.array([[1, 0], [0, 0]], robot.dtype)
        a, b, gamma = jnp.asarray(self.mount, robot.dtype)
        in_robot = jnp.stack([jnp.stack([jnp.ones_like(b), -b]), jnp.stack([jnp.zeros_like(a), a])])
        return se2.rotation(gamma).T @ in_robot


def _inverse_square(p: Array) -> tuple[Array, Array]:
    """A point (2,) and 1/|p|²; zero, with zero derivatives, at the origin."""
    square = p[0] * p[0] + p[1] * p[1]
    away = square > 0
    per_square = jnp.where(away, 1 / jnp.where(away, square, 1.0), 0.0)
    return jnp.where(away, p, 0.0), per_square
