"""Recovery of a kidnapped robot: injection of particles from anywhere it may be.

Thrun, Burgard & Fox, "Probabilistic Robotics", table 8.3, augmented MCL.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.core.protocols import Differentiable, Resample
from jaxslam.filters.particles.pose_particles import PoseParticles, Region
from jaxslam.math.arrays import Number
from jaxslam.resampling.weights import survivors


def update_averages(
    state: PoseParticles,
    misfit: Float[Array, "P"],
    measured: Int[Array, ""],
    rates: tuple[Number, Number] | None,
) -> PoseParticles:
    """The state with updated likelihood averages and the injection probability.

    While no particle has had a weight, there is no average, and all particles are drawn again.

    Args:
        misfit: of each particle: Σ d²/2, or the negative log-likelihood of the scan; a constant
            does not matter, since only the ratio of the averages does.
        measured: how many measurements the scan has.
        rates: of the long-term and of the short-term average; None injects nothing.
    """
    if rates is None:
        return state._replace(injection=jnp.zeros_like(state.fast))
    finite = jnp.isfinite(misfit)
    exponent = -jnp.where(finite, misfit, 0.0) / jnp.maximum(measured, 1)
    each = jnp.where(finite, jnp.exp(exponent), 0.0)
    fit = jax.lax.stop_gradient((jnp.exp(state.log_weight) * each).sum())
    first = state.slow <= 0
    slow, fast = (
        jnp.where(first, fit, before + jnp.asarray(rate, fit.dtype) * (fit - before))
        for before, rate in zip((state.slow, state.fast), rates, strict=True)
    )
    safe = jnp.where(slow > 0, slow, 1.0)
    # Without an average no particle has a weight, now or before: all are lost.
    injection = jnp.where(slow > 0, jnp.maximum(0.0, 1 - fast / safe), 1.0)
    some = measured > 0
    return state._replace(
        fast=jnp.where(some, fast, state.fast),
        slow=jnp.where(some, slow, state.slow),
        injection=jnp.where(some, injection, jnp.zeros_like(injection)),
    )


class _DrawnPoses(NamedTuple):
    """P resampled or injected poses, in random order."""

    pose: Float[Array, "P 3"]
    log_weight: Float[Array, "P"]
    injected: Bool[Array, "P"]
    """drawn from the whole region"""


def resample_and_inject(
    state: PoseParticles,
    key: Array,
    resample: Resample | Differentiable,
    region: Region | None,
) -> _DrawnPoses:
    """Poses resampled by weight or, with the state's injection probability, drawn from a
    region."""
    particles = len(state.pose)
    key_resample, key_order, key_which, key_anywhere = jax.random.split(key, 4)
    ancestor, log_weight = survivors(resample, state.log_weight, key_resample)
    # Ancestors ascend, and only the first ones may be used.
    order = jax.random.permutation(key_order, particles)
    pose, log_weight = state.pose[ancestor[order]], log_weight[order]
    if region is None:
        return _DrawnPoses(pose, log_weight, jnp.zeros(particles, bool))
    injected = jax.random.uniform(key_which, (particles,), pose.dtype) < state.injection
    anywhere = region.draw(particles, key_anywhere, pose.dtype)
    return _DrawnPoses(
        jnp.where(injected[:, None], anywhere, pose),
        jnp.where(injected, -math.log(particles), log_weight),
        injected,
    )
