"""The canonical (information) form of a Gaussian over a robot and some landmarks: its atoms.

The error e = x - μ of robot and A landmarks, D = 3 + A·L, has the information matrix Ω (D, D), the
inverse of its covariance, and the vector ρ = Ω E[e], what the mean is still *owed*: the textbooks'
ξ = Ω μ + ρ. Holding ρ instead of ξ changes no equation and spares much: a heading may wrap, a large
map does not cancel in float32, ρ = 0 says that μ is the mean, and what leaves the mean alone
(sparsification: ξ̃ = ξ + (Ω̃ - Ω) μ) leaves ρ alone.

Padding, a place without a landmark: zero mean, zero links, unit diagonal of Ω, zero of ρ.
Sources: Thrun et al., "Simultaneous localization and mapping with sparse extended information
filters", IJRR 23(7-8), 2004; the Notes, with the corrections of ERRATA.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.derivatives import observe_jacobians
from jaxslam.filters.reporting import info_of, status_of
from jaxslam.linearize import first_order
from jaxslam.math import linalg
from jaxslam.math.angles import wrap
from jaxslam.protocols import Motion, Sensor
from jaxslam.types import Info, Scan


class Weighed(NamedTuple):
    """What a scan's M measurements say of the errors, in units of their own noise."""

    rows: jax.Array
    """(M·Z, D) N⁻¹ H, R = N Nᵀ; zero for what is not fused"""
    innovation: jax.Array
    """(M·Z,) N⁻¹ ν of the same"""
    known: jax.Array
    """(M,) bool: of a landmark of the map, and compared with it"""
    positive: jax.Array
    """(M,) bool: S, R and Ω are positive definite"""
    inside: jax.Array
    """(M,) bool: within the gate"""
    fused: jax.Array
    """(M,) bool: known, positive and inside"""
    nu: jax.Array
    """(M, Z) innovations ν"""
    s: jax.Array
    """(M, Z, Z) S of each alone"""
    nis: jax.Array
    """(M,) of fused places given those before, of the others alone"""
    log_likelihood: jax.Array
    """(M,), 0 where not fused"""
    sound: jax.Array
    """() bool: Ω is positive definite"""


def started(pose_cov: jax.Array, floor: float) -> jax.Array:
    """P0⁻¹ (3, 3), of P0 + floor² I where P0 is not positive definite: certainty has no inverse."""
    eye = jnp.eye(3, dtype=pose_cov.dtype)
    positive = linalg.cholesky(pose_cov)[1]
    safe = jnp.where(positive, pose_cov, pose_cov + floor**2 * eye)
    return linalg.symmetrize(linalg.solve_psd(safe, eye)[0])


def check_floor(name: str, floor: float) -> None:
    """Raise ValueError unless the floor is above 0."""
    if not floor > 0:
        raise ValueError(f"{name}: expected a floor above 0, got {floor}")


def moved(
    motion: Motion, pose: jax.Array, u: jax.Array, omega: jax.Array, owed: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The motion update: pose (3,), Ω (D, D), ρ (D,) after a control; 3x3 inversions alone.

    With F = ∂f/∂pose and S Sᵀ = W Q Wᵀ (any rank), Φ = F⁻ᵀ Ω F⁻¹ and φ = F⁻ᵀ ρ on the robot's rows,

        G = Φ S (I + Sᵀ Φ S)⁻¹,   Ω ← (I - G Sᵀ) Φ (I - G Sᵀ)ᵀ + G Gᵀ,   ρ ← φ - G Sᵀ φ,

    which is (Φ⁻¹ + W Q Wᵀ)⁻¹ by the inversion lemma, in Joseph's form: rounding cannot make it
    indefinite as quickly. G is zero beyond the landmarks that the robot is linked to.
    """
    after, by_pose, noise = first_order.motion_at(motion, pose, u, pose)
    root = linalg.root_psd(noise)
    back = linalg.inverse(by_pose)
    phi = omega.at[:3].set(back.T @ omega[:3])
    phi = phi.at[:, :3].set(phi[:, :3] @ back)
    owed = owed.at[:3].set(back.T @ owed[:3])
    seen = root.T @ phi[:3]
    inner = jnp.eye(3, dtype=omega.dtype) + seen[:, :3] @ root
    gain = (linalg.inverse(linalg.symmetrize(inner)) @ seen).T
    left = phi - gain @ seen
    omega = left - (left[:, :3] @ root) @ gain.T + gain @ gain.T
    return after, linalg.symmetrize(omega), owed - gain @ (root.T @ owed[:3])


def rows_at(by_pose: jax.Array, own: jax.Array, place: jax.Array, count: int) -> jax.Array:
    """(m·k, D) of rows by the pose (m, k, 3) and by the landmark (m, k, L) of a place (m,)."""
    m, k, size = own.shape
    at = (place[:, None] == jnp.arange(count)[None, :]).astype(own.dtype)
    wide = jnp.einsum("mkl,ma->mkal", own, at).reshape(m, k, count * size)
    return jnp.concatenate([by_pose, wide], axis=2).reshape(m * k, 3 + count * size)


def weigh(
    omega: jax.Array,
    pose: jax.Array,
    landmarks: jax.Array,
    scan: Scan,
    place: jax.Array,
    known: jax.Array,
    sensor: Sensor,
    gate: float | None,
) -> Weighed:
    """Measurements z (M, Z) of the landmarks (A, L) in places (M,), where known (M,).

    NIS and gate are of S = H Ω⁻¹ Hᵀ + R, Ω factored once. A measurement whose R or S is not
    positive definite does nothing and is `Status.SINGULAR`, as are all where Ω is not.
    """
    m, size_z = scan.z.shape
    z = jnp.where(scan.valid[:, None], scan.z, 0.0)
    landmark = landmarks[place]
    expected = jax.vmap(sensor.observe, (None, 0))(pose, landmark)
    by_pose, by_own = jax.vmap(lambda at: observe_jacobians(sensor, pose, at))(landmark)
    nu = jax.vmap(sensor.residual)(z, expected)
    noise = jax.vmap(sensor.noise_cov)(z)
    h = rows_at(by_pose, by_own, place, landmarks.shape[0])
    factor, sound = linalg.cholesky(omega)
    seen = linalg.solve_lower(factor, h.T)
    same = jnp.eye(m, dtype=z.dtype)[:, None, :, None]
    s = (seen.T @ seen).reshape(m, size_z, m, size_z) + same * noise[:, :, None]
    marginal = s[jnp.arange(m), :, jnp.arange(m)]
    distance, positive = jax.vmap(_squared)(nu, marginal)
    root, noisy = jax.vmap(linalg.cholesky)(noise)
    inside = jnp.isfinite(distance) if gate is None else distance <= gate
    positive = positive & noisy & sound
    fused = known & inside & positive
    both = fused[:, None, None, None] & fused[None, None, :, None]
    unit = same * jnp.eye(size_z, dtype=z.dtype)[None, :, None]
    whiten = linalg.whitener_by_rows(jnp.where(both, s, unit).reshape(m * size_z, m * size_z))[0]
    fused_nu = jnp.where(fused[:, None], nu, 0.0)
    nis = ((whiten @ fused_nu.reshape(-1)).reshape(m, size_z) ** 2).sum(axis=1)
    pivots = jnp.diagonal(whiten).reshape(m, size_z)
    log_det = -2 * jnp.log(jnp.where(pivots > 0, pivots, 1.0)).sum(axis=1)
    likelihood = -0.5 * (nis + log_det + size_z * jnp.log(2 * jnp.pi))

    def whitened(root: jax.Array, values: jax.Array) -> jax.Array:
        return linalg.solve_lower(root, values)

    rows = jax.vmap(whitened)(root, h.reshape(m, size_z, h.shape[1]))
    return Weighed(
        rows=jnp.where(fused[:, None, None], rows, 0.0).reshape(h.shape),
        innovation=jax.vmap(whitened)(root, fused_nu).reshape(-1),
        known=known,
        positive=positive,
        inside=inside,
        fused=fused,
        nu=nu,
        s=marginal,
        nis=jnp.where(fused, nis, distance),
        log_likelihood=jnp.where(fused, likelihood, 0.0),
        sound=sound,
    )


def informed(omega: jax.Array, owed: jax.Array, of: Weighed) -> tuple[jax.Array, jax.Array]:
    """The measurement update: Ω ← Ω + Σ Hᵀ R⁻¹ H, ρ ← ρ + Σ Hᵀ R⁻¹ ν."""
    return linalg.symmetrize(omega + of.rows.T @ of.rows), owed + of.rows.T @ of.innovation


def stepped(pose: jax.Array, step: jax.Array) -> jax.Array:
    """The pose (3,) moved by an error (3,), its heading wrapped."""
    there = pose + step
    return there.at[2].set(wrap(there[2]))


def born(
    omega: jax.Array,
    pose: jax.Array,
    z: jax.Array,
    place: jax.Array,
    granted: jax.Array,
    sensor: Sensor,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """New landmarks of measurements (m, Z) in empty places (m,): Ω, the landmarks (m, L), granted.

    l = g(x, z), with C = G_z R G_zᵀ + G_s S G_sᵀ: Ω ← Ω + Jᵀ C⁻¹ J, J = [-G_x, I], the same as
    augmentation in covariance form (Solà (32)-(38)), and ρ as it is. Places whose C is not positive
    definite are not granted.
    """
    size = len(sensor.landmark)
    count = (omega.shape[0] - 3) // size
    z = jnp.where(granted[:, None], z, 1.0)
    landmark, by_pose, own = jax.vmap(lambda z: first_order.invert_at(sensor, pose, z, pose, z))(z)
    root, positive = jax.vmap(linalg.cholesky)(own)
    granted = granted & positive
    unit = jnp.broadcast_to(jnp.eye(size, dtype=omega.dtype), own.shape)
    both = jax.vmap(linalg.solve_lower)(root, jnp.concatenate([-by_pose, unit], axis=2))
    both = jnp.where(granted[:, None, None], both, 0.0)
    rows = rows_at(both[:, :, :3], both[:, :, 3:], place, count)
    filled = (granted[:, None] & (place[:, None] == jnp.arange(count)[None, :])).any(axis=0)
    # Padding's unit goes first, to an exact zero.
    empty = jnp.concatenate([jnp.zeros(3, bool), jnp.repeat(filled, size)])
    omega = omega - jnp.diag(empty.astype(omega.dtype)) + rows.T @ rows
    return linalg.symmetrize(omega), landmark, granted


def judged(weighed: Weighed, sound: jax.Array) -> Weighed:
    """What was weighed, where the scan could be solved for, sound (), or else all singular."""
    return weighed._replace(
        positive=weighed.positive & sound,
        log_likelihood=jnp.where(sound, weighed.log_likelihood, 0.0),
    )


def reported(
    weighed: Weighed,
    scan: Scan,
    slot: jax.Array,
    *,
    matched: jax.Array | None = None,
    **fates: jax.Array,
) -> Info:
    """The info of a scan with its slots (M,).

    matched: (M,) bool, those of landmarks of the map, where more than were weighed. fates: as
    `reporting.status_of` has them.
    """
    known = weighed.known
    status = status_of(
        scan.valid,
        matched=known if matched is None else matched,
        positive=weighed.positive,
        inside=weighed.inside,
        **fates,
    )
    return info_of(
        status,
        known,
        size=scan.z.shape[1],
        slot=slot,
        born=slot,
        nis=weighed.nis,
        innovation=weighed.nu,
        innovation_cov=weighed.s,
        log_likelihood=weighed.log_likelihood.sum(),
    )


def loaded(omega: jax.Array) -> jax.Array:
    """Ω with √eps of its diagonal added: what is tried where rounding has made it indefinite."""
    share = math.sqrt(float(jnp.finfo(omega.dtype).eps))
    more: jax.Array = share * jnp.diag(jnp.abs(jnp.diagonal(omega)))
    return omega + more


def _squared(nu: jax.Array, cov: jax.Array) -> tuple[jax.Array, jax.Array]:
    factor, positive = linalg.cholesky(cov)
    return (linalg.solve_lower(factor, nu) ** 2).sum(), positive
