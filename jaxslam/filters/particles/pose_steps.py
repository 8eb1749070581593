"""The steps of Monte-Carlo localization in any known map: motion, number, weights, recovery."""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.filters.particles.proposal import sample_motion
from jaxslam.filters.particles.recovery import resample_and_inject, update_averages
from jaxslam.filters.particles.settings import MonteCarloSettings
from jaxslam.filters.particles.states.particle_info import ParticleInfo
from jaxslam.filters.particles.states.pose_state import (
    ParticleEvents,
    PoseParticles,
    active_mask,
    draw_start,
    no_events,
)
from jaxslam.resampling.kld import bins_of, enough
from jaxslam.resampling.weights import effective_size, normalized


def predict_particles(
    state: PoseParticles, u: Float[Array, "U"], key: Array, settings: MonteCarloSettings
) -> PoseParticles:
    """The particles resampled where due and moved, as many as the KLD bound requires."""
    key_start, key_renew, key_noise = jax.random.split(key, 3)
    state = draw_start(state, key_start, settings)
    due, particles = state.due, settings.particles
    drawn = resample_and_inject(state, key_renew, settings)
    old = jnp.where(due, drawn.pose, state.pose)
    moved = sample_motion(settings.motion, old, u, key_noise)
    good = jnp.isfinite(moved).all(axis=1)
    pose = jnp.where(good[:, None], moved, old)
    bins = bins_of(pose, settings.bins)
    count, few = enough(bins, settings.least, settings.error, settings.confidence)
    active = jnp.where(due, count, state.active)
    used = jnp.arange(particles) < active
    log_weight = jnp.where(used, drawn.log_weight, -jnp.inf)
    # The sum becomes 1; its gradient is the resampling method's.
    log_weight = log_weight - normalized(jax.lax.stop_gradient(log_weight))[1]
    log_weight = jnp.where(due, log_weight, state.log_weight)
    before = state.events
    return state._replace(
        pose=pose,
        log_weight=jnp.where(good, log_weight, -jnp.inf),
        active=active,
        due=jnp.asarray(False),
        injection=jnp.zeros_like(state.injection),
        events=ParticleEvents(
            resampled=before.resampled | due,
            injected=before.injected + (due & drawn.injected & used).sum().astype(jnp.int32),
            invalid=before.invalid + (used & ~good).sum().astype(jnp.int32),
            capped=before.capped | (due & few),
        ),
    )


def weigh_particles(
    state: PoseParticles,
    misfit: Float[Array, "P"],
    fit: Float[Array, "P"],
    measured: Int[Array, ""],
    settings: MonteCarloSettings,
) -> tuple[PoseParticles, ParticleInfo]:
    """The particles weighted by exp(-misfit), with what is decided for the next motion.

    Args:
        misfit: the negative log-likelihood of the scan at each particle, up to a constant.
        fit: what recovery compares with other scans, as `update_averages` takes it.
        measured: how many measurements the scan has.
    """
    weight, some = weight_poses(state, misfit)
    ess = effective_size(weight)
    found = ParticleInfo(ess=ess, underflow=~some, active=state.active, **state.events._asdict())
    state = update_averages(state, fit, measured, settings)
    lost = settings.injects & (state.injection > 0)
    state = state._replace(
        log_weight=weight,
        best=jnp.argmax(weight).astype(jnp.int32),
        due=(ess < settings.threshold * state.active) | lost,
        events=no_events(),
    )
    return state, found


def weight_poses(
    state: PoseParticles, misfit: Float[Array, "P"]
) -> tuple[Float[Array, "P"], Bool[Array, ""]]:
    """Log-weights log w exp(-misfit) with Σ w = 1, equal where all underflow, and whether any
    weight was left."""
    weight, _, some = normalized(state.log_weight - misfit)
    even = jnp.where(active_mask(state), -jnp.log(state.active.astype(weight.dtype)), -jnp.inf)
    return jnp.where(some, weight, even), some
