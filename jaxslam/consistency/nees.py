"""The NEES of a pose, eᵀ P⁻¹ e with e = truth - estimate, of its blocks, and in own coordinates."""

import jax
import jax.numpy as jnp

from jaxslam.angles import wrap
from jaxslam.linalg import mahalanobis_leading, mahalanobis_squared
from jaxslam.protocols import Chart, Sensor
from jaxslam.types import Trace, Truth

DOF = {"pose": 3, "position": 2, "heading": 1}
"""Blocks of the pose error whose NEES is taken, and the mean of an honest one."""

ROUNDING = 32
"""A claimed deviation of at most so many ulp of its coordinate is taken for zero."""


def pose_error(truth: jax.Array, pose: jax.Array) -> jax.Array:
    """truth - estimate (T, 3), heading wrapped."""
    error = truth - pose
    return jnp.concatenate([error[:, :2], wrap(error[:, 2:])], axis=1)


def block_nees(
    pose: jax.Array, error: jax.Array, own: jax.Array, cov: jax.Array
) -> dict[str, tuple[jax.Array, jax.Array]]:
    """NEES (T,), and where there is one, of the blocks of `DOF` and of the own error.

    There is none where the claimed covariance is singular, and none where a claimed deviation is
    what rounding makes of zero: at most `ROUNDING` ulp of the coordinate, that is of π for the
    heading and of max(|x|, |y|) for the position. So particles that are copies of one, whose sample
    covariance is zero but for rounding, have no NEES, instead of one of 1e27.

    Args:
        pose: (T, 3) as estimated; error, own: (T, 3); cov: (T, 3, 3) as claimed.
    """

    def one(
        errors: jax.Array, cov: jax.Array, scale: jax.Array
    ) -> dict[str, tuple[jax.Array, jax.Array]]:
        position, pose = mahalanobis_leading(errors, cov, (2, 3), scale)
        return {
            "position": (position[0][0], position[1][0]),
            "pose": (pose[0][0], pose[1][0]),
            "own": (pose[0][1], pose[1][1]),
            "heading": mahalanobis_squared(errors[2:, 0], cov[2:, 2:], scale[2:]),
        }

    return jax.vmap(one)(jnp.stack([error, own], axis=2), cov, _scale(pose, cov))


def mean_pose_nees(
    truth: jax.Array, pose: jax.Array, cov: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The mean over time of a run's pose NEES, and whether there is one, () each.

    It is `score`'s measure of that name, alone: a program that compiles in a fraction of the time.

    Args:
        truth, pose: (T, 3); cov: (T, 3, 3), what the filter claims.
    """

    def one(error: jax.Array, cov: jax.Array, scale: jax.Array) -> tuple[jax.Array, jax.Array]:
        return mahalanobis_leading(error, cov, (DOF["pose"],), scale)[0]

    nees, regular = jax.vmap(one)(pose_error(truth, pose), cov, _scale(pose, cov))
    count = regular.sum()
    finite = jnp.isfinite(pose).all() & jnp.isfinite(cov).all()
    return nees.sum() / jnp.maximum(count, 1), finite & (count > 0)


def own_error_of(chart: Chart, sensor: Sensor, trace: Trace, truth: Truth) -> jax.Array:
    """The pose error in the filter's coordinates, brought to (x, y, θ) by its basis, (T, 3).

    ξᵀ P_ξ⁻¹ ξ = (E ξ)ᵀ P⁻¹ (E ξ) with P = E P_ξ Eᵀ as the filter reports it.
    """
    ground = jnp.zeros(len(sensor.landmark), truth.pose.dtype)

    def one(pose: jax.Array, true_pose: jax.Array) -> jax.Array:
        dx, _ = chart.local(pose, ground, true_pose, ground)
        return dx if chart.basis is None else chart.basis(pose, ground).pose @ dx

    return jax.vmap(one)(trace.estimate.pose, truth.pose)


def _scale(pose: jax.Array, cov: jax.Array) -> jax.Array:
    """Units (T, 3) in which a pose covariance is judged: x and y, both metres, have one; 0 where
    it is rounding."""
    variance = jnp.maximum(jnp.diagonal(cov, axis1=1, axis2=2), 0.0)
    spread = jnp.stack([variance[:, :2].max(axis=1)] * 2 + [variance[:, 2]], axis=1)
    reach = jnp.abs(pose[:, :2]).max(axis=1)
    size = jnp.stack([reach, reach, jnp.full_like(reach, jnp.pi)], axis=1)
    there = spread > (ROUNDING * float(jnp.finfo(cov.dtype).eps) * size) ** 2
    return jnp.where(there, jnp.sqrt(jnp.where(there, spread, 1.0)), 0.0)
