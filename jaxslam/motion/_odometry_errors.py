"""Systematic errors of odometry: scales, unequal wheels, and a robot that drives at an angle."""

import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from jaxslam.core._record import field, record
from jaxslam.core.protocols import Motion
from jaxslam.core.validation import instance_of
from jaxslam.math import se2
from jaxslam.math._arrays import Control, ProcessNoise, Robot

_TRAVEL, _ACROSS, _TURN = ("v", "forward"), ("left",), ("omega", "turn")
"""Names of the controls, velocities or increments, that are corrected."""


def can_correct(motion: Motion) -> bool:
    """Whether a motion model has the controls, travel and turn, that `Corrected` corrects."""
    names = {name.split(" ")[0] for name in motion.controls}
    return bool(names & set(_TRAVEL)) and bool(names & set(_TURN))


def _check_correctable(motion: Motion) -> Motion:
    instance_of(Motion)(motion)
    if not can_correct(motion):
        raise ValueError(
            "expected a motion model with controls v and omega, or forward and turn, got "
            f"{', '.join(motion.controls)}"
        )
    return motion


@record
class Corrected(Motion):
    """The motion model of a robot whose recorded odometry has systematic errors.

    Recorded travel u and turn ω, both velocities or both increments, move the robot by

        u' = travel u - outer |ω|,    ω' = turn ω + curvature u,    scale = (travel, turn)

    along the direction `heading` of the robot. A left increment is multiplied by `travel`. Of two
    wheels half a track `outer` from the centre, the recorded speed is close to that of the outer
    one; wheels of unequal size bend the path of a robot that drives straight ahead (Borenstein &
    Feng, IEEE Trans. Robotics and Automation 12(6), 1996). `heading` is the angle between the axes
    of the robot, in which its sensor is mounted and its pose reported, and the direction in which
    it drives.

    Raises ValueError on a model without travel and turn among its controls.
    """

    motion: Motion = field(check=_check_correctable)
    """the model of the recorded controls without errors"""
    scale: ArrayLike = (1.0, 1.0)
    """(travel, turn)"""
    wheels: ArrayLike = (0.0, 0.0)
    """(outer [m], curvature [rad/m])"""
    heading: ArrayLike = 0.0
    """[rad]"""

    @property
    def name(self) -> str:  # type: ignore[override]
        return self.motion.name

    @property
    def state(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.motion.state

    @property
    def controls(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.motion.controls

    @property
    def noises(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.motion.noises

    @property
    def equations(self) -> str:  # type: ignore[override]
        if not self.motion.equations:
            return ""
        names = [name.split(" ")[0] for name in self.motion.controls]
        u, omega = (next(name for name in names if name in of) for of in (_TRAVEL, _TURN))
        across = [f"{name} = travel*{name}" for name in names if name in _ACROSS]
        return "\n".join(
            [
                "travel, turn_scale = scale",
                "outer, curvature = wheels",
                *across,
                f"{u}, {omega} = "
                f"travel*{u} - outer*abs({omega}), turn_scale*{omega} + curvature*{u}",
                "theta = theta + heading",
                self.motion.equations,
                "theta1 = wrap(theta1 - heading)",
            ]
        )

    def step(self, pose: Robot, u: Control, w: ProcessNoise) -> Robot:
        # Into the direction in which the robot drives, and back to its axes.
        moved = self.motion.step(self._turn_pose(pose, 1.0), self.control(u), w)
        return self._turn_pose(moved, -1.0)

    def noise_cov(self, pose: Robot, u: Control) -> Array:
        cov: Array = self.motion.noise_cov(self._turn_pose(pose, 1.0), self.control(u))
        return cov

    def control(self, u: Control) -> Control:
        """The control (U,) without its systematic errors."""
        names = [name.split(" ")[0] for name in self.motion.controls]
        along, turn = (next(k for k, n in enumerate(names) if n in of) for of in (_TRAVEL, _TURN))
        scale, wheels = (jnp.asarray(pair, u.dtype) for pair in (self.scale, self.wheels))
        corrected = list(u)  # other entries, as the interval, stay
        corrected[along] = scale[0] * u[along] - wheels[0] * jnp.abs(u[turn])
        corrected[turn] = scale[1] * u[turn] + wheels[1] * u[along]
        for k, name in enumerate(names):
            if name in _ACROSS:
                corrected[k] = scale[0] * u[k]
        return jnp.stack(corrected)

    def _turn_pose(self, pose: Robot, sign: float) -> Robot:
        heading = sign * jnp.asarray(self.heading, pose.dtype)
        turn = jnp.stack([0.0 * heading, 0.0 * heading, heading])
        if len(pose) == 3:
            return se2.compose(pose, turn)
        return jnp.concatenate([se2.compose(pose[:3], turn), pose[3:]])
