"""The Ackermann model of a car steered at its front wheels; the pose is that of its laser."""

import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from jaxslam.core._record import field, record
from jaxslam.core.noise import NoiseCov
from jaxslam.core.protocols import Motion
from jaxslam.core.validation import finite, positive
from jaxslam.math import se2
from jaxslam.math._arrays import Control, Pose, ProcessNoise, StepJacobians, as_array


@record
class Ackermann(Motion):
    """The Ackermann motion model, integrated exactly along an arc.

    u = (v_e [m/s], steering α [rad], Δt [s]), with noise added to v_e and α.

    v_e is the speed of the rear wheel with the encoder, H to the left of the axle's centre. The
    centre moves at v = v_e/(1 - (H/L) tan α) and the car turns at ω = v tan α/L. The pose is that
    of a sensor fixed at (a ahead, b left) of the centre, with the car's heading:

        pose ← pose ∘ (-a, -b, 0) ∘ exp(vΔt, 0, ωΔt) ∘ (a, b, 0) = pose ∘ exp((v - ωb)Δt, ωaΔt, ωΔt)

    the twist being the centre's, seen at the sensor. The Euler step of this is the published model,

        x + Δt(v cos θ - ω(a sin θ + b cos θ)),  y + Δt(v sin θ + ω(a cos θ - b sin θ)),  θ + Δt ω

    of Guivant & Nebot, IEEE Trans. Robotics and Automation 17(3), 2001. The defaults are the truck
    they drove through Victoria Park.

    Precondition, not checked: |α| < π/2 and |α| < atan(L/|H|), noise included. At the second bound
    the car turns about the encoder's wheel, whose speed then does not determine the car's.

    Raises ValueError unless noise_cov is a (2, 2) covariance, the lengths are finite, and wheelbase
    is positive.
    """

    noise_cov: NoiseCov
    """(2, 2) covariance of w on (v_e, α), or a function of (pose, u)."""
    wheelbase: ArrayLike = field(default=2.83, check=lambda length: as_array(positive(length)))
    """L [m], from the rear to the front axle; positive."""
    sensor: ArrayLike = field(default=(3.78, 0.5), check=finite(2))
    """(2,) = (a, b) [m]."""
    encoder: ArrayLike = field(default=0.76, check=finite())
    """H [m]; negative on the right, 0 where v_e is the centre's speed."""
    controls = ("v_e [m/s]", "steering [rad]", "dt [s]")
    noises = ("v_e [m/s]", "steering [rad]")
    equations = (
        "a, b = sensor\n"
        "curvature = tan(steering + w_steering)/wheelbase\n"
        "travel = (v_e + w_v_e)/(1 - encoder*curvature)*dt\n"
        "arc = curvature*travel\n"
        "ahead = sinc(arc/2)*(travel - arc*b)\n"
        "left = sinc(arc/2)*arc*a\n"
        "x1 = x + ahead*cos(theta + arc/2) - left*sin(theta + arc/2)\n"
        "y1 = y + ahead*sin(theta + arc/2) + left*cos(theta + arc/2)\n"
        "theta1 = wrap(theta + arc)"
    )

    def _rates(self, u: Control) -> tuple[Array, Array, Array]:
        """Speed v, gain v/v_e and the sensor's twist over v (3,), from curvature κ = tan α/L."""
        a, b = jnp.asarray(self.sensor, u.dtype)
        curvature = jnp.tan(u[1]) / jnp.asarray(self.wheelbase, u.dtype)
        gain = 1 / (1 - jnp.asarray(self.encoder, u.dtype) * curvature)
        return u[0] * gain, gain, jnp.stack([1 - curvature * b, curvature * a, curvature])

    def step(self, pose: Pose, u: Control, w: ProcessNoise) -> Pose:
        v, _, direction = self._rates(self.perturb(u, w))
        return se2.boxplus(pose, u[2] * v * direction)

    def perturb(self, u: Control, w: ProcessNoise) -> Control:
        return jnp.stack([u[0] + w[0], u[1] + w[1], u[2]])

    def jacobians(self, pose: Pose, u: Control, w: ProcessNoise) -> StepJacobians:
        dt, tan = u[2], jnp.tan(u[1] + w[1])
        v, gain, direction = self._rates(self.perturb(u, w))
        by_pose, by_move = se2.compose_jacobians(pose, se2.exp(dt * v * direction))
        (by_twist,) = se2.exp_jacobians(dt * v * direction)
        # dv/dκ = v·gain·H, dκ/dα = (1 + tan² α)/L, and the direction is linear in κ.
        a, b = jnp.asarray(self.sensor, u.dtype)
        slope = jnp.asarray(self.encoder, u.dtype) * gain * direction + jnp.stack(
            [-b, a, jnp.ones_like(a)]
        )
        by_alpha = v * slope * (1 + tan**2) / jnp.asarray(self.wheelbase, u.dtype)
        # The twist is Δt v times the direction: columns by v_e, α and Δt.
        by_rates = jnp.stack([dt * gain * direction, dt * by_alpha, v * direction], axis=1)
        by_control = by_move @ by_twist @ by_rates
        return by_pose, by_control, by_control[:, :2]
