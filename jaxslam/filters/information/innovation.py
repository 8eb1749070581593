"""The gated innovations of a scan in the canonical form, and their information."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.filters.information.settings import InformationFilter
from jaxslam.linearize.first_order import observe_jacobians
from jaxslam.math import linalg
from jaxslam.math.gaussians import gaussian_terms, log_density, log_det_of_pivots
from jaxslam.types import Scan


class CanonicalInnovations(NamedTuple):
    """Innovations of the M measurements (Z) of a scan, and their information."""

    whitened_jacobian: Float[Array, "MZ D"]
    """N⁻¹ H, R = N Nᵀ; zero where not fused"""
    whitened: Float[Array, "MZ"]
    """N⁻¹ ν of the same"""
    compared: Bool[Array, "M"]
    """of a landmark of the map, and compared with it"""
    positive: Bool[Array, "M"]
    """S, R and Ω are positive definite"""
    inside: Bool[Array, "M"]
    """within the gate"""
    innovation: Float[Array, "M Z"]
    """ν"""
    innovation_cov: Float[Array, "M Z Z"]
    """S of each alone"""
    nis: Float[Array, "M"]
    """of fused measurements given those before, of the others alone"""
    log_likelihood: Float[Array, "M"]
    """0 where not fused"""
    omega_positive: Bool[Array, ""]
    """Ω is positive definite"""


def innovations(
    settings: InformationFilter,
    omega: Float[Array, "D D"],
    pose: Float[Array, "3"],
    landmarks: Float[Array, "A L"],
    scan: Scan,
    index: Int[Array, "M"],
    known: Bool[Array, "M"],
) -> CanonicalInnovations:
    """Gated innovations ν = z ⊖ h(x, l) and S = H Ω⁻¹ Hᵀ + R; Ω is factored once.

    A measurement whose R or S is not positive definite has no effect and is `Status.SINGULAR`, as
    are all where Ω is not.

    Args:
        index: which of the landmarks each measurement is of, where known.
    """
    sensor, gate = settings.sensor, settings.gate
    m, size = scan.z.shape
    z = jnp.where(scan.valid[:, None], scan.z, 0.0)
    measured = landmarks[index]
    predicted = jax.vmap(sensor.observe, (None, 0))(pose, measured)
    by_pose, by_landmark = jax.vmap(lambda at: observe_jacobians(sensor, pose, at))(measured)
    innovation = jax.vmap(sensor.residual)(z, predicted)
    noise = jax.vmap(sensor.noise_cov)(z)
    jacobian = stack_jacobians(by_pose, by_landmark, index, landmarks.shape[0])

    factor, omega_positive = linalg.cholesky(omega)
    half = linalg.solve_lower(factor, jacobian.T)
    same = jnp.eye(m, dtype=z.dtype)[:, None, :, None]
    joint_cov = (half.T @ half).reshape(m, size, m, size) + same * noise[:, :, None]
    innovation_cov = joint_cov[jnp.arange(m), :, jnp.arange(m)]
    alone = jax.vmap(gaussian_terms)(innovation, innovation_cov)
    noise_factor, noise_positive = jax.vmap(linalg.cholesky)(noise)
    positive = alone.positive & noise_positive & omega_positive
    inside = jnp.isfinite(alone.distance) if gate is None else alone.distance <= gate
    fused = known & inside & positive

    fused_innovation = jnp.where(fused[:, None], innovation, 0.0)
    nis, log_likelihood = _densities_in_turn(fused_innovation, joint_cov, fused)
    rows = jax.vmap(linalg.solve_lower)(noise_factor, jacobian.reshape(m, size, jacobian.shape[1]))
    return CanonicalInnovations(
        whitened_jacobian=jnp.where(fused[:, None, None], rows, 0.0).reshape(jacobian.shape),
        whitened=jax.vmap(linalg.solve_lower)(noise_factor, fused_innovation).reshape(-1),
        compared=known,
        positive=positive,
        inside=inside,
        innovation=innovation,
        innovation_cov=innovation_cov,
        nis=jnp.where(fused, nis, alone.distance),
        log_likelihood=jnp.where(fused, log_likelihood, 0.0),
        omega_positive=omega_positive,
    )


def stack_jacobians(
    by_pose: Float[Array, "M Z 3"],
    by_landmark: Float[Array, "M Z L"],
    index: Int[Array, "M"],
    count: int,
) -> Float[Array, "MZ D"]:
    """The Jacobian H of M functions of pose and a landmark, index of `count`; D = 3 + count·L."""
    m, rows, size = by_landmark.shape
    at = (index[:, None] == jnp.arange(count)[None, :]).astype(by_landmark.dtype)
    wide = jnp.einsum("mkl,ma->mkal", by_landmark, at).reshape(m, rows, count * size)
    return jnp.concatenate([by_pose, wide], axis=2).reshape(m * rows, 3 + count * size)


def _densities_in_turn(
    innovation: Float[Array, "M Z"],
    joint_cov: Float[Array, "M Z M Z"],
    fused: Bool[Array, "M"],
) -> tuple[Float[Array, "M"], Float[Array, "M"]]:
    """The distance d² and log-density of each fused innovation given those before it."""
    m, size = innovation.shape
    both = fused[:, None, None, None] & fused[None, None, :, None]
    eye = jnp.eye(m * size, dtype=innovation.dtype)
    fused_cov = jnp.where(both, joint_cov, eye.reshape(joint_cov.shape))
    inverse_factor = linalg.whitener_by_rows(fused_cov.reshape(eye.shape))[0]
    distance = (inverse_factor @ innovation.reshape(-1)).reshape(m, size) ** 2
    log_det = -log_det_of_pivots(jnp.diagonal(inverse_factor).reshape(m, size))
    nis = distance.sum(axis=1)
    return nis, log_density(nis, log_det, size)


def refuse_unless(solved: Bool[Array, ""], of: CanonicalInnovations) -> CanonicalInnovations:
    """The innovations, all marked singular if the mean could not be solved for."""
    return of._replace(
        positive=of.positive & solved,
        log_likelihood=jnp.where(solved, of.log_likelihood, 0.0),
    )
