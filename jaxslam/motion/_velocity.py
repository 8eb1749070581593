"""The velocity motion model: constant velocities, integrated exactly, then a final rotation."""

import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from jaxslam.core._record import field, record
from jaxslam.core.noise import NoiseCov
from jaxslam.core.protocols import Motion
from jaxslam.core.validation import finite
from jaxslam.math import se2
from jaxslam.math._arrays import Control, Pose, ProcessNoise, ProcessNoiseCov, StepJacobians


@record
class Velocity(Motion):
    """The velocity motion model: Notes 3.

    u = (v [m/s], ω [rad/s], Δt [s]); w = (w_v [m/s], w_ω [rad/s], w_γ [rad/s]).

    With v̂ = v + w_v and ω̂ = ω + w_ω, an arc of radius v̂/ω̂ followed by the final rotation w_γ Δt:

        pose ← pose ∘ exp(v̂Δt, 0, ω̂Δt),  θ ← wrap(θ + w_γ Δt).

    That is x + (v̂/ω̂)(sin(θ+ω̂Δt) - sin θ), y + (v̂/ω̂)(cos θ - cos(θ+ω̂Δt)), θ + (ω̂+w_γ)Δt (errata:
    the Notes mix v/r into it), but smooth through ω̂ = 0. Without w_γ the three coordinates would
    have noise in two directions only. Probabilistic Robotics, ch. 5.3; `VelocityNoise` is its
    covariance.
    """

    noise_cov: NoiseCov
    """(3, 3) covariance of w, or a function of (pose, u): of the *velocity* over the interval, so
    the displacement's grows with Δt²."""
    controls = ("v [m/s]", "omega [rad/s]", "dt [s]")
    noises = ("v [m/s]", "omega [rad/s]", "gamma [rad/s]")
    equations = (
        "arc = (omega + w_omega)*dt\n"
        "chord = (v + w_v)*dt*sinc(arc/2)\n"
        "x1 = x + chord*cos(theta + arc/2)\n"
        "y1 = y + chord*sin(theta + arc/2)\n"
        "theta1 = wrap(theta + arc + w_gamma*dt)"
    )
    # No `perturb`: the final rotation is not a control, so no u does what w_γ does.

    def _twist(self, u: Control, w: ProcessNoise) -> Array:
        v, omega, dt = u[0] + w[0], u[1] + w[1], u[2]
        return jnp.stack([v * dt, jnp.zeros_like(dt), omega * dt])

    def step(self, pose: Pose, u: Control, w: ProcessNoise) -> Pose:
        zero, final = jnp.zeros_like(u[2]), w[2] * u[2]
        return se2.compose(pose, se2.exp(self._twist(u, w)) + jnp.stack([zero, zero, final]))

    def jacobians(self, pose: Pose, u: Control, w: ProcessNoise) -> StepJacobians:
        twist, dt, zero = self._twist(u, w), u[2], jnp.zeros_like(u[2])
        by_pose, by_move = se2.compose_jacobians(pose, se2.exp(twist))
        (by_twist,) = se2.exp_jacobians(twist)
        by_v, by_omega = by_move @ by_twist[:, 0] * dt, by_move @ by_twist[:, 2] * dt
        # The twist is Δt times the rates, and the final rotation w_γ Δt.
        rates = jnp.stack([u[0] + w[0], zero, u[1] + w[1]])
        by_dt = (by_move @ (by_twist @ rates)).at[2].add(w[2])
        by_gamma = jnp.stack([zero, zero, dt])
        by_control = jnp.stack([by_v, by_omega, by_dt], axis=1)
        return by_pose, by_control, jnp.stack([by_v, by_omega, by_gamma], axis=1)


@record
class VelocityNoise:
    """The diagonal covariance of the noise of `Velocity`, a function (pose, u) -> (3, 3).

        var v = α1 v² + α2 ω²,   var ω = α3 v² + α4 ω²,   var γ = α5 v² + α6 ω²

    Variances, as in Probabilistic Robotics, Table 5.3; they do not depend on Δt.
    """

    alpha: ArrayLike = field(check=finite(6, least=0.0))
    """(6,) α1, α4, α6 [1], α2 [m²/rad²], α3, α5 [rad²/m²], not negative"""
    equations = (
        "a1, a2, a3, a4, a5, a6 = alpha\n"
        "variance_of_w_v = a1*v**2 + a2*omega**2\n"
        "variance_of_w_omega = a3*v**2 + a4*omega**2\n"
        "variance_of_w_gamma = a5*v**2 + a6*omega**2"
    )

    def __call__(self, pose: Pose, u: Control) -> ProcessNoiseCov:
        a1, a2, a3, a4, a5, a6 = jnp.asarray(self.alpha, pose.dtype)
        v, omega = u[0] ** 2, u[1] ** 2
        return jnp.diag(jnp.stack([a1 * v + a2 * omega, a3 * v + a4 * omega, a5 * v + a6 * omega]))
