"""Monte-Carlo localization in any known map: motion, number, weights, and recovery of a lost robot.

Recovery: Thrun, Burgard & Fox, "Probabilistic Robotics", table 8.3, augmented MCL.
"""

import dataclasses
import math
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from jaxslam.charts import Euclidean
from jaxslam.core._numbers import is_concrete
from jaxslam.core._record import field, function_of, record, static
from jaxslam.core.protocols import Differentiable, Filter, Motion, Resample
from jaxslam.core.types import Estimate
from jaxslam.core.validation import InvalidField, at_least, in_range, one_of, or_none
from jaxslam.filters._particles.pose_particles import (
    ParticleEvents,
    PoseParticles,
    Region,
    active_mask,
    box_ends,
    draw_start,
    initial_pose_particles,
    no_events,
    pose_particle_moments,
)
from jaxslam.filters._particles.proposal import sample_motion
from jaxslam.filters._particles.slam_particles import ParticleInfo
from jaxslam.math._arrays import Number
from jaxslam.resampling._kld import bins_of, enough
from jaxslam.resampling._methods import systematic
from jaxslam.resampling._weights import effective_size, normalize, survivors


def update_averages(
    state: PoseParticles,
    misfit: Float[Array, "P"],
    measured: Int[Array, ""],
    rates: tuple[Number, Number] | None,
) -> PoseParticles:
    """The state with updated likelihood averages and the injection probability.

    While no particle has had a weight, there is no average, and all particles are drawn again.

    Args:
        misfit: Σ d²/2 of each particle, or the negative log-likelihood of the scan; a constant
            does not matter, since only the ratio of the averages does.
        measured: number of measurements of the scan.
        rates: α_slow and α_fast of the averages; None injects nothing.
    """
    if rates is None:
        return state._replace(injection=jnp.zeros_like(state.fast))
    finite = jnp.isfinite(misfit)
    exponent = -jnp.where(finite, misfit, 0.0) / jnp.maximum(measured, 1).astype(misfit.dtype)
    likelihood = jnp.where(finite, jnp.exp(exponent), 0.0)
    # A random choice, injection, follows from the averages: it has no derivative.
    fit = jax.lax.stop_gradient((jnp.exp(state.log_weight) * likelihood).sum())
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


def resample_and_inject(
    state: PoseParticles,
    key: Array,
    resample: Resample | Differentiable,
    region: Region | None,
) -> tuple[Float[Array, "P 3"], Float[Array, "P"], Bool[Array, "P"]]:
    """Poses resampled by weight or, with the state's injection probability, drawn from a region.

    Returns:
        P poses in random order, their log-weights, and the mask of those drawn from the region.
    """
    particles = len(state.pose)
    key_resample, key_order, key_which, key_anywhere = jax.random.split(key, 4)
    ancestor, log_weight = survivors(resample, state.log_weight, key_resample)
    # Ancestors ascend, and only the first ones may be used.
    order = jax.random.permutation(key_order, particles)
    pose, log_weight = state.pose[ancestor[order]], log_weight[order]
    if region is None:
        return pose, log_weight, jnp.zeros(particles, bool)
    injected = jax.random.uniform(key_which, (particles,), pose.dtype) < state.injection
    anywhere = region.draw(particles, key_anywhere, pose.dtype)
    return (
        jnp.where(injected[:, None], anywhere, pose),
        jnp.where(injected, -math.log(particles), log_weight),
        injected,
    )


_LEAST = 50
"""The default of `MonteCarloFilter.least`."""

_BINS = (0.5, 0.5, math.radians(15))
"""Sizes of the bins in x [m], y [m], θ [rad] whose number bounds that of the particles."""

_ERROR, _CONFIDENCE = 0.05, 0.99
"""With this confidence the Kullback-Leibler divergence is below the error (Fox 2003)."""


def _check_rates(rates: tuple[Number, Number]) -> tuple[Number, Number]:
    """The check of the rates of two averages."""
    if not isinstance(rates, tuple | list) or len(rates) != 2:
        raise ValueError(f"expected (slow, fast), got {rates!r}")
    if is_concrete(rates) and not 0 < rates[0] <= rates[1] <= 1:
        raise ValueError(f"expected (slow, fast) with 0 < slow <= fast <= 1, got {rates!r}")
    return rates[0], rates[1]


class _Particles(Filter):
    """The declarations of a subclass of `MonteCarloFilter`."""

    motion: Motion
    particles: int
    """the capacity P"""
    region: Any
    """the `Region` where the robot may be, or None"""


@record
class MonteCarloFilter(_Particles):
    """A particle filter in a known map: start, number of particles, resampling and recovery.

    Raises ValueError on counts below 1 or least above particles, a box that is not finite or has no
    inside, start "uniform" without a region, a threshold outside [0, 1], or invalid rates.
    """

    _: dataclasses.KW_ONLY
    start: Literal["gaussian", "uniform"] = static(
        default="gaussian", check=one_of("gaussian", "uniform")
    )
    """"gaussian", the pose and covariance given to `run` (the latter may be zero), or "uniform",
    anywhere with any heading, for any initial pose (global localization)"""
    box: ArrayLike | None = field(default=None, check=or_none(box_ends))
    """(2, 2) the lowest and the highest (x, y) [m] where the robot may be"""
    resample: Resample | Differentiable = field(
        default=systematic, check=function_of("log_weights", "key")
    )
    """one of `jaxslam.resampling`; also `Soft` or `StopGradient` of one"""
    threshold: Number = field(default=1.0, check=in_range(0.0, 1.0))
    """ESS below which to resample, as a share of the particles in use; 1 resamples (and chooses
    their number) in every step with unequal weights, 0 only to inject. If odometry is more precise
    than the scans, copies stay together, and a lower threshold makes the covariance more
    consistent"""
    least: int | None = static(default=None, check=or_none(at_least(1)))
    """least number of particles in use; default 50, or the capacity if that is less. With
    least = particles their number is fixed"""
    forget: tuple[Number, Number] | None = field(default=(0.01, 0.1), check=or_none(_check_rates))
    """α_slow, α_fast with 0 < α_slow <= α_fast <= 1; None injects nothing"""
    chart = Euclidean()

    def __post_init__(self) -> None:
        if self.least is not None and self.least > self.particles:
            reason = f"expected at most particles = {self.particles}, got {self.least}"
            raise InvalidField("least", reason)
        super().__post_init__()

    @property
    def fewest(self) -> int:
        """`least`, or its default."""
        return min(_LEAST, self.particles) if self.least is None else self.least

    def init(self, pose: Float[Array, "3"], pose_cov: Float[Array, "3 3"]) -> PoseParticles:
        return initial_pose_particles(pose, pose_cov, self.particles, self._start_region)

    def predict(self, state: PoseParticles, u: Float[Array, "U"], key: Array) -> PoseParticles:
        """The particles resampled where due and moved, as many as the KLD bound requires."""
        key_start, key_renew, key_noise = jax.random.split(key, 3)
        state = draw_start(state, key_start, self._start_region)
        due = state.due
        resampled, weight_resampled, injected = resample_and_inject(
            state, key_renew, self.resample, None if self.forget is None else self.region
        )
        # Copies of one particle are separated by the noise of the motion.
        old = jnp.where(due, resampled, state.pose)
        moved = sample_motion(self.motion, old, u, key_noise)
        good = jnp.isfinite(moved).all(axis=1)
        pose = jnp.where(good[:, None], moved, old)
        # The number of particles follows from the bins that they occupy after the motion.
        count, few = enough(bins_of(pose, _BINS), self.fewest, _ERROR, _CONFIDENCE)
        active = jnp.where(due, count, state.active)
        used = jnp.arange(self.particles, dtype=active.dtype) < active
        log_weight = jnp.where(used, weight_resampled, -jnp.inf)
        # The sum becomes 1; its gradient is the resampling method's.
        log_weight = log_weight - normalize(jax.lax.stop_gradient(log_weight))[1]
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
                injected=before.injected + (due & injected & used).sum().astype(jnp.int32),
                invalid=before.invalid + (used & ~good).sum().astype(jnp.int32),
                capped=before.capped | (due & few),
            ),
        )

    def weigh(
        self,
        state: PoseParticles,
        misfit: Float[Array, "P"],
        fit: Float[Array, "P"],
        measured: Int[Array, ""],
    ) -> tuple[PoseParticles, ParticleInfo]:
        """The particles weighted by exp(-misfit), with the decisions for the next motion.

        Args:
            misfit: negative log-likelihood of the scan at each particle, up to a constant.
            fit: the misfit that recovery compares with other scans (`update_averages`).
            measured: number of measurements of the scan.
        """
        weight, _, some = normalize(state.log_weight - misfit)
        even = jnp.where(active_mask(state), -jnp.log(state.active.astype(weight.dtype)), -jnp.inf)
        weight = jnp.where(some, weight, even)
        ess = effective_size(weight)
        particles = ParticleInfo(
            ess=ess, underflow=~some, active=state.active, **state.events._asdict()
        )
        state = update_averages(state, fit, measured, self.forget)
        injects = self.region is not None and self.forget is not None
        lost = injects & (state.injection > 0)
        state = state._replace(
            log_weight=weight,
            best=jnp.argmax(weight).astype(jnp.int32),
            due=(ess < self.threshold * state.active.astype(ess.dtype)) | lost,
            events=no_events(),
        )
        return state, particles

    def pose_estimate(
        self, state: PoseParticles, points: Float[Array, "N 2"], tags: Int[Array, "N"]
    ) -> Estimate:
        """The estimate of the pose in a map of points without error."""
        pose, cov = pose_particle_moments(state)
        return Estimate(
            pose=pose,
            pose_cov=cov,
            points=points,
            point_covs=jnp.zeros((len(points), 2, 2), pose.dtype),
            alive=jnp.ones(len(points), bool),
            tag=tags,
        )

    @property
    def _start_region(self) -> Region | None:
        return self.region if self.start == "uniform" else None
