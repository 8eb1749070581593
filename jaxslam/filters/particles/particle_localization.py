"""Monte-Carlo localization in a known map, including global localization."""

import math
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxslam import validation
from jaxslam.filters.known.localization import checked_map
from jaxslam.filters.particles.likelihood import ScanLikelihood, scan_likelihood
from jaxslam.filters.particles.pose_steps import pose_filter, weigh_particles
from jaxslam.filters.particles.scan_association import zero_padding
from jaxslam.filters.particles.settings import (
    MonteCarloSettings,
    checked_box,
    checked_least,
    known_map_sensors,
)
from jaxslam.filters.particles.states.moments import weighted_nis
from jaxslam.filters.particles.states.pose_state import (
    PoseParticles,
    draw_start,
)
from jaxslam.filters.particles.states.region import box_region
from jaxslam.filters.reporting import info_of, status_of, with_extra
from jaxslam.protocols import Associate, Differentiable, Filter, Motion, Resample, Sensor
from jaxslam.resampling.systematic import systematic
from jaxslam.resampling.weights import normalized
from jaxslam.sensors.suite import Suite
from jaxslam.types import Info, Scan


def particle_localization(
    motion: Motion,
    sensor: Sensor,
    landmarks: ArrayLike,
    particles: int,
    *,
    tags: ArrayLike | None = None,
    box: ArrayLike | None = None,
    start: Literal["gaussian", "uniform"] = "gaussian",
    associate: Associate | None = None,
    gate: float | None = None,
    resample: Resample | Differentiable = systematic,
    threshold: float = 1.0,
    bins: tuple[float, float, float] = (0.5, 0.5, math.radians(15)),
    error: float = 0.05,
    confidence: float = 0.99,
    least: int | None = None,
    forget: tuple[float, float] | None = (0.01, 0.1),
    slack: float = 1.0,
) -> Filter:
    """Monte-Carlo localization with an adaptive number of particles, and recovery when lost.

    Poses are drawn from the motion with its noise and weighted by the scan, p(z | x, map), the map
    being without error (Dellaert, Fox, Burgard & Thrun 1999; Thrun, Burgard & Fox, "Probabilistic
    Robotics", table 8.2). The state is a `PoseParticles`. Particles are resampled before a motion,
    if the last scan left ESS = 1/Σ w² below threshold · (particles in use). The number of particles
    in use is then the KLD bound for the bins that they occupy after the motion (Fox 2001;
    `resampling.kld`), at most `particles`; the others have weight zero. In
    `info.extra["particles"]`, a `ParticleInfo`, see `active` and `capped`.

    A kidnapped robot is found again by particles from the whole box (table 8.3). With c the
    weighted average over the particles of exp(-Σ d²/2m) over the m measurements of a scan,

        slow ← slow + α_slow (c - slow)     fast ← fast + α_fast (c - fast)

    each particle drawn is from the box with probability max(0, 1 - slack · fast/slow) instead
    (`injected`). c is the table's likelihood in units of its peak and per measurement, so that it
    does not depend on how many landmarks are in view; the first scan sets both averages; scans
    without a measurement change nothing. slack above 1 injects less (Gutmann & Fox 2002).

    The estimate is that of the weighted particles after a scan, before resampling:
    `moments.weighted_pose_moments`, a single mean and covariance even if the particles form several
    modes. Where all weights underflow, all in use become equal (`underflow`). A motion
    that leaves a non-finite pose is undone, and the particle gets weight zero (`invalid`).
    The measurements in an `Info` are those of the most likely particle, and nis is the mean over
    the particles by weight, as of `fastslam`; log_likelihood is log Σ w p(scan | x) of measurements
    matched to a landmark.

    Shapes are fixed, so the cost of a step depends on the capacity, not on the particles in use.

    With a precise sensor no particle may lie within its noise (particle deprivation), and all may
    converge to a wrong position. Then take more particles, or inflate the sensor noise, as is
    customary; the estimate is then conservative.

    Args:
        motion, sensor: any; with a `sensors.suite`, absolute sensors enter the weights too.
        landmarks: (N, L) the map, in the sensor's parameters.
        particles: the capacity P, at least 1.
        tags: (N,) int, different; default the row numbers.
        box: (2, 2) the lowest and the highest (x, y) [m] where the robot may be; without one,
            nothing is injected.
        start: "gaussian", the pose and covariance given to `run` (the latter may be zero), or
            "uniform", the whole box and any heading, whatever is given (global localization).
        associate: default `association.known()`, by tag. Any other decides for each particle, by
            its pose alone (maximum_likelihood with an infinite gate: the most likely landmark).
        gate: a measurement whose squared Mahalanobis distance exceeds this counts as one on the
            gate, and is reported as rejected; default none.
        resample: one of `jaxslam.resampling`; also `soft` or `stop_gradient` of one.
        threshold: of ESS, as a share; 1 resamples (and chooses the number) in every step with
            unequal weights, 0 only to inject. Where odometry is precise beside the scans, copies
            stay together, and a lower threshold gives a more consistent covariance.
        bins: sizes in x [m], y [m], θ [rad].
        error, confidence: of the bound: with this probability the Kullback-Leibler divergence is
            below the error.
        least: never fewer particles; default 50, or the capacity if that is less. As many as the
            capacity: a fixed number.
        forget: α_slow, α_fast with 0 < α_slow <= α_fast <= 1; None injects nothing.
        slack: above 0.
    Raises:
        ValueError: on counts below 1 or least above particles, a map or tags as `localization`
            refuses them, a box that is not finite or has no inside, start "uniform" without a box,
            a threshold outside [0, 1], a gate, bins, error or slack not above 0, a confidence not
            within (0, 1), or invalid rates.
    """
    validation.check_models("particle_localization", motion, sensor)
    points, names = checked_map("particle_localization", sensor, landmarks, tags)
    if start == "uniform" and box is None:
        raise ValueError("particle_localization: expected a box with a uniform start, got none")
    limits = checked_box("particle_localization", box)
    settings = MonteCarloSettings(
        name="particle_localization",
        motion=motion,
        particles=particles,
        region=None if limits is None else box_region(limits),
        start=start,
        resample=resample,
        threshold=threshold,
        bins=bins,
        error=error,
        confidence=confidence,
        least=checked_least("particle_localization", particles, least),
        rates=forget,
        slack=slack,
    )
    sensors = known_map_sensors("particle_localization", sensor, points, names, associate, gate)

    def update(state: PoseParticles, scan: Scan, key: Array) -> tuple[PoseParticles, Info]:
        state, scan = draw_start(state, key, settings), zero_padding(scan)
        likelihood = jax.vmap(partial(scan_likelihood, scan=scan, sensors=sensors))(state.pose)
        log_likelihood = normalized(state.log_weight + likelihood.log_density.sum(axis=1))[1]
        # Besides d², a weight has the term log |2πR|, which is the same for all.
        misfit = 0.5 * likelihood.counted.sum(axis=1)
        measured = likelihood.measured[0].sum()
        state, found = weigh_particles(state, misfit, misfit, measured, settings)
        info = info_of_scan(scan, likelihood, state.log_weight, log_likelihood)
        return state, with_extra(info, "particles", found)

    def known_points(pose: Float[Array, "3"]) -> Float[Array, "N 2"]:
        return jax.vmap(sensor.position)(jnp.asarray(points, pose.dtype))

    places = sensor.places if isinstance(sensor, Suite) else ()
    return pose_filter(settings, update, sensor.measurements, known_points, names, places)


def info_of_scan(
    scan: Scan,
    likelihood: ScanLikelihood,
    log_weight: Float[Array, "P"],
    log_likelihood: Float[Array, ""],
) -> Info:
    """The `Info` of the most likely particle, with the weighted mean NIS."""
    best = jnp.argmax(log_weight)
    own: ScanLikelihood = jax.tree.map(lambda of_all: of_all[best], likelihood)
    return info_of(
        status_of(scan.valid, matched=own.matched, positive=own.positive, inside=own.inside),
        own.matched,
        size=own.dof,
        slot=own.slot,
        nis=weighted_nis(likelihood.nis, likelihood.matched, log_weight),
        innovation=own.innovation,
        innovation_cov=own.innovation_cov,
        log_likelihood=log_likelihood,
        exhausted=likelihood.exhausted.any(),
    )
