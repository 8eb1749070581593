"""Systematic errors and noise of MRCLAM's robots, as a record that the readers apply."""

from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxslam.core.noise import NoiseCov

Numbers = TypeVar("Numbers", np.ndarray, jax.Array)


class RobotCalibration(NamedTuple):
    """The systematic errors of a robot's odometry and camera, and the noise that remains.

    A recorded velocity (v, ω) at time t moves the robot at time t + delay, by

        v' = forward v - outer |ω|,    ω' = turn ω + curvature v

    since v is rather the speed of the outer wheel, half a track `outer` from the centre, and since
    wheels of unequal size bend the path of a robot that is told to go straight (Borenstein & Feng
    1996). The camera is at (ahead, 0, yaw) on the robot. Its range r is `depth` times the depth
    along the optical axis, as the height of a barcode in the image gives it. That axis has the
    bearing `axis`, so that with the recorded bearing φ the range is

        r' = r / (depth cos(φ - axis))

    Arrays and fields may be NumPy's or traced.

    White noise per second has the variance forward_noise² of travel and turn_noise² +
    (turn_share ω')² of heading. The range has the standard deviation range_share r', the bearing
    bearing_noise.
    """

    delay: float
    """[s], of odometry after measurements"""
    forward: float
    outer: float
    """[m]"""
    turn: float
    curvature: float
    """[rad/m]"""
    depth: float
    ahead: float
    """[m]"""
    yaw: float
    """[rad]"""
    axis: float
    """[rad]"""
    forward_noise: float
    """[m/√s]"""
    turn_noise: float
    """[rad/√s]"""
    turn_share: float
    """[√s]"""
    range_share: float
    bearing_noise: float
    """[rad]"""

    def odometry(self, recorded: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "K 3"]:
        """The lines (t, v, ω) corrected, at the times when the robot moves."""
        t, v, omega = recorded.T
        return np.column_stack([t + self.delay, *self.velocities(v, omega)])

    def velocities(self, v: Numbers, omega: Numbers) -> tuple[Numbers, Numbers]:
        """The calibrated velocities (v', ω') of recorded ones."""
        return self.forward * v - self.outer * abs(omega), self.turn * omega + self.curvature * v

    def range(self, recorded: Numbers, bearing: Numbers) -> Numbers:
        """The calibrated range r' of a recorded range and bearing."""
        cos = jnp.cos if isinstance(bearing, jax.Array) else np.cos
        return recorded / (self.depth * cos(bearing - self.axis))

    def measurements(self, recorded: Float[np.ndarray, "J 4"]) -> Float[np.ndarray, "J 4"]:
        """The lines (t, barcode, range, bearing) with ranges corrected.

        Raises ValueError on a bearing beyond a right angle, behind the image plane.
        """
        beyond = np.abs(recorded[:, 3] - self.axis) >= np.pi / 2
        if beyond.any():
            bearing = recorded[beyond, 3][0]
            raise ValueError(f"Calibration: expected bearings below π/2, got {bearing}")
        corrected = recorded.copy()
        corrected[:, 2] = self.range(recorded[:, 2], recorded[:, 3])
        return corrected

    @property
    def mount(self) -> Float[np.ndarray, "3"]:
        """The pose of the camera on the robot."""
        return np.array([self.ahead, 0.0, self.yaw])

    def odometry_cov(self) -> NoiseCov:
        """The covariance (2, 2) of (v', ω') over an interval Δt, a function of (pose, u)."""

        def noise_cov(pose: jax.Array, u: jax.Array) -> jax.Array:
            by_turn = (self.turn_share * u[1]) ** 2
            forward = self.forward_noise**2 + 0 * by_turn
            return per_interval(jnp.stack([forward, self.turn_noise**2 + by_turn]), u[2])

        return noise_cov

    def measurement_cov(self) -> NoiseCov:
        """The covariance (2, 2) of (r', φ), a function of z."""

        def noise_cov(z: jax.Array) -> jax.Array:
            share = self.range_share * z[0]
            return jnp.diag(jnp.stack([share, self.bearing_noise + 0 * share]) ** 2)

        return noise_cov


MRCLAM_CALIBRATION = RobotCalibration(
    delay=0.265,
    forward=1.049,
    outer=0.098,
    turn=0.956,
    curvature=-0.039,
    depth=1.017,
    ahead=-0.034,
    yaw=0.0,
    axis=0.0,
    forward_noise=0.0091,
    turn_noise=0.0219,
    turn_share=0.186,
    range_share=0.0098,
    bearing_noise=0.0183,
)
"""Fitted on the true path of robot 1 of data set 6 (`python -m benchmarks --only mrclam_fit`).

The yaw and the axis of the camera are left at zero, since they differ from robot to robot;
`mrclam_calibration` finds them in a robot's own log.

The ranges of that robot deviate from the survey by 0.12 m as recorded, by a function of the
bearing, and by 1 % of the range once corrected. Errors that last are counted in full: the noise of
the odometry is that of windows of 8 s, that of the camera of single measurements and the truth."""


def check_calibration(name: str, calibration: object) -> None:
    """Raise ValueError, which begins with the caller's name, unless it is a RobotCalibration of
    finite numbers, its depth above 0, its noise not negative."""
    if not isinstance(calibration, RobotCalibration):
        raise ValueError(f"{name}: expected a RobotCalibration, got {type(calibration).__name__}")
    for field, value in calibration._asdict().items():
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = np.nan
        good, wanted = np.isfinite(number), "a finite number"
        if field == "depth":
            good, wanted = good and number > 0, f"{wanted} above 0"
        elif field.endswith(("_noise", "_share")):
            good, wanted = good and number >= 0, f"{wanted} >= 0"
        if not good:
            raise ValueError(
                f"{name}: expected the {field} of a calibration to be {wanted}, got {value!r}"
            )


def per_interval(density: jax.Array, dt: jax.Array) -> jax.Array:
    """The diagonal covariance density/Δt of velocities over Δt, zero where Δt = 0."""
    moving = dt > 0
    return jnp.diag(density) * jnp.where(moving, 1 / jnp.where(moving, dt, 1.0), 0.0)


def recorded(
    odometry: Float[np.ndarray, "K 3"],
    seen: Float[np.ndarray, "J 4"],
    calibration: RobotCalibration | None,
) -> tuple[Float[np.ndarray, "K 3"], Float[np.ndarray, "J 4"]]:
    """The lines of a robot as they are, or corrected."""
    if calibration is None:
        return odometry, seen
    return calibration.odometry(odometry), calibration.measurements(seen)
