"""Filter steps in the canonical (information) form of a Gaussian over a robot and A landmarks.

The error e = x - μ, D = R + A·L numbers, R = 3 of a pose, has the information matrix Ω (D, D), the
inverse of its covariance, and the information residual ρ = Ω E[e] (D,): the textbooks' information
vector is ξ = Ω μ + ρ. Storing ρ instead of ξ is equivalent, and has advantages: a heading may wrap,
a large map causes no cancellation in float32, ρ = 0 means that μ is the mean, and operations that
keep the mean (sparsification: ξ̃ = ξ + (Ω̃ - Ω) μ) keep ρ.

Padding, an index without a landmark: zero mean, zero links, unit diagonal of Ω, zero of ρ.
Sources: Thrun et al., "Simultaneous localization and mapping with sparse extended information
filters", IJRR 23(7-8), 2004; the Notes, with the corrections of the errata.
"""

import math

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.core.protocols import Motion, Sensor
from jaxslam.core.types import Info, Scan
from jaxslam.filters._information.tag_innovation import (
    CanonicalInnovations,
    TagAssociation,
    stack_jacobians,
)
from jaxslam.filters._reporting import info_of, status_of
from jaxslam.linearize import _first_order as first_order
from jaxslam.math import _linalg as linalg
from jaxslam.math._arrays import Number
from jaxslam.math.angles import wrap


def initial_information(pose_cov: Float[Array, "R R"], floor: Number) -> Float[Array, "R R"]:
    """The first information P0⁻¹, or (P0 + floor² I)⁻¹ where P0 is not positive definite."""
    eye = jnp.eye(len(pose_cov), dtype=pose_cov.dtype)
    positive = linalg.cholesky(pose_cov)[1]
    safe = jnp.where(positive, pose_cov, pose_cov + jnp.asarray(floor, eye.dtype) ** 2 * eye)
    return linalg.symmetrize(linalg.solve_psd(safe, eye)[0])


def motion_update(
    motion: Motion,
    pose: Float[Array, "R"],
    u: Float[Array, "U"],
    omega: Float[Array, "D D"],
    residual: Float[Array, "D"],
) -> tuple[Float[Array, "R"], Float[Array, "D D"], Float[Array, "D"]]:
    """Pose, Ω and ρ after a control, by R×R inversions only.

    With F = ∂f/∂pose and S Sᵀ = W Q Wᵀ (any rank), Φ = F⁻ᵀ Ω F⁻¹ and φ = F⁻ᵀ ρ on the robot's rows,

        G = Φ S (I + Sᵀ Φ S)⁻¹,   Ω ← (I - G Sᵀ) Φ (I - G Sᵀ)ᵀ + G Gᵀ,   ρ ← φ - G Sᵀ φ,

    which is (Φ⁻¹ + W Q Wᵀ)⁻¹ by the inversion lemma, in Joseph's form, which is less sensitive to
    rounding. G is zero except for the landmarks that the robot is linked to.
    """
    n = len(pose)
    after, by_pose, noise = first_order.motion_at(motion, pose, u, pose)
    root = linalg.root_psd(noise)
    back = linalg.inverse(by_pose)
    # F concerns the robot alone: only its rows and columns change.
    phi = omega.at[:n].set(back.T @ omega[:n])
    phi = phi.at[:, :n].set(phi[:, :n] @ back)
    residual = residual.at[:n].set(back.T @ residual[:n])
    # Sᵀ Φ; the inner matrix I + Sᵀ Φ S is R×R and positive definite for any rank of S.
    by_noise = root.T @ phi[:n]
    inner = jnp.eye(n, dtype=omega.dtype) + by_noise[:, :n] @ root
    gain = (linalg.inverse(linalg.symmetrize(inner)) @ by_noise).T
    # (I - G Sᵀ) Φ, and below its product with (I - G Sᵀ)ᵀ.
    left = phi - gain @ by_noise
    omega = left - (left[:, :n] @ root) @ gain.T + gain @ gain.T
    return after, linalg.symmetrize(omega), residual - gain @ (root.T @ residual[:n])


def measurement_update(
    omega: Float[Array, "D D"], residual: Float[Array, "D"], innovations: CanonicalInnovations
) -> tuple[Float[Array, "D D"], Float[Array, "D"]]:
    """The update Ω ← Ω + Σ Hᵀ R⁻¹ H, ρ ← ρ + Σ Hᵀ R⁻¹ ν."""
    rows = innovations.whitened_jacobian
    return linalg.symmetrize(omega + rows.T @ rows), residual + rows.T @ innovations.whitened


def mean_error(
    omega: Float[Array, "D D"], residual: Float[Array, "D"], omega_positive: Bool[Array, ""]
) -> tuple[Float[Array, "D"], Bool[Array, ""]]:
    """The mean error Ω⁻¹ ρ, and whether Ω is positive definite, here and before the scan
    (omega_positive); zero where it is not."""
    error, positive = linalg.solve_psd(omega, residual)
    solved = omega_positive & positive
    return jnp.where(solved, error, 0.0), solved


def correct_pose(
    pose: Float[Array, "R"], error: Float[Array, "R"], turns: tuple[int, ...] = (2,)
) -> Float[Array, "R"]:
    """The pose, or robot, moved by an error, its angles wrapped; turns: the entries they are."""
    moved = pose + error
    for k in turns:
        moved = moved.at[k].set(wrap(moved[k]))
    return moved


def initialize_landmarks(
    sensor: Sensor,
    omega: Float[Array, "D D"],
    pose: Float[Array, "R"],
    z: Float[Array, "M Z"],
    index: Int[Array, "M"],
    wanted: Bool[Array, "M"],
) -> tuple[Float[Array, "D D"], Float[Array, "M L"], Bool[Array, "M"]]:
    """Ω with new landmarks at empty indices where wanted, the landmarks, and the mask of those
    initialized.

    l = g(x, z), with C = G_z R G_zᵀ + G_s S G_sᵀ: Ω ← Ω + Jᵀ C⁻¹ J, J = [-G_x, I]; ρ does not
    change. This is the augmentation in covariance form, Solà (32)-(38). A landmark whose C is not
    positive definite is not initialized.
    """
    size, n = len(sensor.landmark), len(pose)
    count = (omega.shape[0] - n) // size
    # Absent measurements are replaced by a value at which every model is smooth.
    z = jnp.where(wanted[:, None], z, 1.0)
    landmark, by_pose, cov = jax.vmap(lambda z: first_order.invert_at(sensor, pose, z, pose, z))(z)
    root, positive = jax.vmap(linalg.cholesky)(cov)
    initialized = wanted & positive
    unit = jnp.broadcast_to(jnp.eye(size, dtype=omega.dtype), cov.shape)
    both = jax.vmap(linalg.solve_lower)(root, jnp.concatenate([-by_pose, unit], axis=2))
    # Rows of zeros add nothing to Jᵀ C⁻¹ J.
    both = jnp.where(initialized[:, None, None], both, 0.0)
    rows = stack_jacobians(both[:, :, :n], both[:, :, n:], index, count)
    slots = jnp.arange(count, dtype=index.dtype)
    filled = (initialized[:, None] & (index[:, None] == slots[None, :])).any(axis=0)
    # Padding's unit goes first, to an exact zero.
    padding = jnp.concatenate([jnp.zeros(n, bool), jnp.repeat(filled, size)])
    omega = omega - jnp.diag(padding.astype(omega.dtype)) + rows.T @ rows
    return linalg.symmetrize(omega), landmark, initialized


def diagonal_loading(omega: Float[Array, "D D"]) -> Float[Array, "D D"]:
    """The matrix Ω plus √eps of its diagonal, used where rounding made Ω indefinite."""
    # Rounding errs by some eps of the diagonal; √eps exceeds that after many steps, and is small.
    share = math.sqrt(float(jnp.finfo(omega.dtype).eps))
    load: Array = share * jnp.diag(jnp.abs(jnp.diagonal(omega)))
    return omega + load


def report(
    scan: Scan,
    association: TagAssociation,
    innovations: CanonicalInnovations,
    initialized: Bool[Array, "M"],
) -> Info:
    """The `Info` of a scan."""
    status = status_of(
        scan.valid,
        matched=association.matched,
        positive=innovations.positive,
        inside=innovations.inside,
        new=association.new,
        repeated=association.repeated,
        granted=initialized,
        singular=association.has_slot,
    )
    return info_of(
        status,
        association.matched,
        size=scan.z.shape[1],
        slot=association.slot,
        born=association.slot,
        nis=innovations.nis,
        innovation=innovations.innovation,
        innovation_cov=innovations.innovation_cov,
        log_likelihood=innovations.log_likelihood.sum(),
    )
