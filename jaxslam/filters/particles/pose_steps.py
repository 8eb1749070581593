"""Monte-Carlo localization in any known map: motion, number, weights, recovery, and the filter."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.charts.euclidean import euclidean
from jaxslam.filters.particles.proposal import sample_motion
from jaxslam.filters.particles.recovery import resample_and_inject, update_averages
from jaxslam.filters.particles.settings import MonteCarloSettings
from jaxslam.filters.particles.states.particle_info import ParticleInfo
from jaxslam.filters.particles.states.pose_state import (
    ParticleEvents,
    PoseParticles,
    active_mask,
    draw_start,
    initial_pose_particles,
    no_events,
    pose_particle_moments,
)
from jaxslam.protocols import Filter
from jaxslam.resampling.kld import bins_of, enough
from jaxslam.resampling.weights import effective_size, normalized
from jaxslam.types import Estimate, Info, Scan

Update = Callable[[PoseParticles, Scan, Array], tuple[PoseParticles, Info]]


def pose_filter(
    settings: MonteCarloSettings,
    update: Update,
    measurements: tuple[str, ...],
    points: Callable[[Float[Array, "3"]], Float[Array, "N 2"]],
    tags: Int[np.ndarray, "N"],
    places: tuple[int, ...] = (),
) -> Filter:
    """The `Filter` of particles in a known map, with this update.

    Args:
        points, tags: of the map, which is without error; the points in the dtype of a pose.
        places: the parts of a suite's scan.
    """

    def init(pose: Float[Array, "3"], pose_cov: Float[Array, "3 3"]) -> PoseParticles:
        return initial_pose_particles(pose, pose_cov, settings)

    def predict(state: PoseParticles, u: Float[Array, "U"], key: Array) -> PoseParticles:
        return predict_particles(state, u, key, settings)

    def estimate(state: PoseParticles) -> Estimate:
        pose, cov = pose_particle_moments(state)
        known = points(pose)
        return Estimate(
            pose=pose,
            pose_cov=cov,
            points=known,
            point_covs=jnp.zeros((len(known), 2, 2), pose.dtype),
            alive=jnp.ones(len(known), bool),
            tag=jnp.asarray(tags),
        )

    return Filter(
        name=settings.name,
        controls=settings.motion.controls,
        measurements=measurements,
        init=init,
        predict=predict,
        update=update,
        estimate=estimate,
        chart=euclidean(),
        places=places,
    )


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
