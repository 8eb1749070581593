"""The velocity motion model: constant velocities, integrated exactly, then a final rotation."""

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from jaxslam.math import se2
from jaxslam.math.arrays import Control, Pose, ProcessNoise, ProcessNoiseCov, StepJacobians
from jaxslam.noise import NoiseCov, noise_model
from jaxslam.protocols import Motion
from jaxslam.validation.numbers import check_alpha


def velocity(noise_cov: NoiseCov) -> Motion:
    """The velocity motion model: Notes 3.

    u = (v [m/s], ω [rad/s], Δt [s]); w = (w_v [m/s], w_ω [rad/s], w_γ [rad/s]).

    With v̂ = v + w_v and ω̂ = ω + w_ω, an arc of radius v̂/ω̂ followed by the final rotation w_γ Δt:

        pose ← pose ∘ exp(v̂Δt, 0, ω̂Δt),  θ ← wrap(θ + w_γ Δt).

    That is x + (v̂/ω̂)(sin(θ+ω̂Δt) - sin θ), y + (v̂/ω̂)(cos θ - cos(θ+ω̂Δt)), θ + (ω̂+w_γ)Δt (errata:
    the Notes mix v/r into it), but smooth through ω̂ = 0. Without w_γ the three coordinates would
    have noise in two directions only. Probabilistic Robotics, ch. 5.3; `velocity_noise` is its
    covariance.

    Args:
        noise_cov: (3, 3) covariance of w, or a function of (pose, u). It is the covariance of the
            *velocity* over the interval, so the displacement's grows with Δt².
    Raises:
        ValueError: if noise_cov is not a (3, 3) covariance.
    """

    def twist_of(u: Control, w: ProcessNoise) -> Array:
        v, omega, dt = u[0] + w[0], u[1] + w[1], u[2]
        return jnp.stack([v * dt, jnp.zeros_like(dt), omega * dt])

    def step(pose: Pose, u: Control, w: ProcessNoise) -> Pose:
        zero, final = jnp.zeros_like(u[2]), w[2] * u[2]
        return se2.compose(pose, se2.exp(twist_of(u, w)) + jnp.stack([zero, zero, final]))

    def jacobians(pose: Pose, u: Control, w: ProcessNoise) -> StepJacobians:
        twist, dt, zero = twist_of(u, w), u[2], jnp.zeros_like(u[2])
        by_pose, by_move = se2.compose_jacobians(pose, se2.exp(twist))
        (by_twist,) = se2.exp_jacobians(twist)
        by_v, by_omega = by_move @ by_twist[:, 0] * dt, by_move @ by_twist[:, 2] * dt
        rates = jnp.stack([u[0] + w[0], zero, u[1] + w[1]])
        by_dt = (by_move @ (by_twist @ rates)).at[2].add(w[2])
        by_gamma = jnp.stack([zero, zero, dt])
        by_control = jnp.stack([by_v, by_omega, by_dt], axis=1)
        return by_pose, by_control, jnp.stack([by_v, by_omega, by_gamma], axis=1)

    return Motion(
        name="velocity",
        controls=("v [m/s]", "omega [rad/s]", "dt [s]"),
        noises=("v [m/s]", "omega [rad/s]", "gamma [rad/s]"),
        step=step,
        noise_cov=noise_model("velocity", noise_cov, 3),
        # No `perturb`: the final rotation is not a control, so no u does what w_γ does.
        jacobians=jacobians,
    )


def velocity_noise(alpha: ArrayLike) -> Callable[[Array, Array], Array]:
    """The function (pose, u) -> (3, 3), the diagonal covariance of `velocity`'s noise.

        var v = α1 v² + α2 ω²,   var ω = α3 v² + α4 ω²,   var γ = α5 v² + α6 ω²

    Units: α1, α4, α6 none, α2 [m²/rad²], α3, α5 [rad²/m²]. Variances, as in Probabilistic
    Robotics, Table 5.3; they do not depend on Δt.

    Args:
        alpha: (6,) α1 … α6, not negative.
    Raises:
        ValueError: if alpha is not six finite numbers >= 0.
    """
    check_alpha("velocity_noise", alpha, 6)

    def noise(pose: Pose, u: Control) -> ProcessNoiseCov:
        a1, a2, a3, a4, a5, a6 = jnp.asarray(alpha, pose.dtype)
        v, omega = u[0] ** 2, u[1] ** 2
        return jnp.diag(jnp.stack([a1 * v + a2 * omega, a3 * v + a4 * omega, a5 * v + a6 * omega]))

    return noise
