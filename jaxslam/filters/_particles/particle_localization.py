"""Monte-Carlo localization in a known map, including global localization."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxslam.association._rules import Known
from jaxslam.core import _validation as validation
from jaxslam.core._record import hold_function, record, static
from jaxslam.core.protocols import Associate, Motion, Sensor
from jaxslam.core.types import Estimate, Info, Scan
from jaxslam.filters._known_map import hold_map, map_tags
from jaxslam.filters._particles.likelihood import ScanLikelihood, scan_likelihood
from jaxslam.filters._particles.particle_settings import known_map_sensors
from jaxslam.filters._particles.pose_particles import Box, PoseParticles, draw_start, weighted_nis
from jaxslam.filters._particles.pose_steps import MonteCarloFilter
from jaxslam.filters._particles.scan_association import zero_padding
from jaxslam.filters._reporting import info_of, status_of, with_extra
from jaxslam.math._arrays import Number
from jaxslam.resampling._weights import normalized


@record
class ParticleLocalization(MonteCarloFilter):
    """Monte-Carlo localization with an adaptive number of particles, and recovery when lost.

    Poses are drawn from the motion with its noise and weighted by the scan, p(z | x, map), the map
    being without error (Dellaert, Fox, Burgard & Thrun 1999; Thrun, Burgard & Fox, "Probabilistic
    Robotics", table 8.2). The state is a `PoseParticles`. Particles are resampled before a motion,
    if the last scan left ESS = 1/Σ w² below threshold · (particles in use). The number of particles
    in use is then the KLD bound for the bins that they occupy after the motion (Fox 2001;
    `resampling.kld_bound`), at most `particles`; the others have weight zero. In
    `info.extra["particles"]`, a `ParticleInfo`, see `active` and `capped`.

    A kidnapped robot is found again by particles from the whole box (table 8.3). With c the
    weighted average over the particles of exp(-Σ d²/2m) over the m measurements of a scan,

        slow ← slow + α_slow (c - slow)     fast ← fast + α_fast (c - fast)

    each particle drawn is from the box with probability max(0, 1 - fast/slow) instead
    (`injected`). c is the table's likelihood in units of its peak and per measurement, so that it
    does not depend on how many landmarks are in view; the first scan sets both averages; scans
    without a measurement change nothing.

    The estimate is that of the weighted particles after a scan, before resampling:
    `weighted_pose_moments`, a single mean and covariance even if the particles form several modes.
    Where all weights underflow, all in use become equal (`underflow`). A motion
    that leaves a non-finite pose is undone, and the particle gets weight zero (`invalid`).
    The measurements in an `Info` are those of the most likely particle, and nis is the mean over
    the particles by weight, as of `FastSlam`; log_likelihood is log Σ w p(scan | x) of measurements
    matched to a landmark.

    Shapes are fixed, so the cost of a step depends on the capacity, not on the particles in use.

    With a precise sensor no particle may lie within its noise (particle deprivation), and all may
    converge to a wrong position. Then take more particles, or inflate the sensor noise, as is
    customary; the estimate is then conservative.

    Raises ValueError as `MonteCarloFilter`, on a map or tags as `Localization` refuses them, or a
    gate not above 0 and below 1.
    """

    motion: Motion
    sensor: Sensor
    """any; with a `sensors.Suite`, absolute sensors enter the weights too"""
    landmarks: ArrayLike
    """(N, L) the map, in the sensor's parameters"""
    particles: int = static()
    """the capacity P, at least 1"""
    _: dataclasses.KW_ONLY
    tags: tuple[int, ...] | None = static(default=None)
    """N different ones, in any form, as of a map of some landmarks; default the row numbers"""
    associate: Associate = Known()
    """any other than by tag decides for each particle, by its pose alone (MaximumLikelihood(None):
    the most likely landmark)"""
    gate: Number | None = None
    """as for `EkfSlam`; a measurement beyond it counts as one on it, and is reported as rejected"""

    def __post_init__(self) -> None:
        name = type(self).__name__
        validation.check_models(name, self.motion, self.sensor)
        validation.check_parts(name, associate=self.associate)
        hold_function(self, "associate", "prediction, scan")
        validation.check_gate(name, self.gate)
        hold_map(self)
        if self.start == "uniform" and self.box is None:
            raise ValueError(f"{name}: expected a box with a uniform start, got none")
        super().__post_init__()

    @property
    def map_size(self) -> int | None:  # type: ignore[override]
        is_whole = self.tags is None and self.sensor.landmark
        return np.shape(self.landmarks)[0] if is_whole else None

    @property
    def region(self) -> Box | None:
        return None if self.box is None else Box(self.box)

    def update(self, state: PoseParticles, scan: Scan, key: Array) -> tuple[PoseParticles, Info]:
        state, scan = draw_start(state, key, self._start_region), zero_padding(scan)
        sensors = known_map_sensors(self)
        likelihood = jax.vmap(partial(scan_likelihood, scan=scan, sensors=sensors))(state.pose)
        log_likelihood = normalized(state.log_weight + likelihood.log_density.sum(axis=1))[1]
        misfit = 0.5 * (likelihood.counted + likelihood.spread).sum(axis=1)
        # Recovery compares scans, and so leaves out how large their noise is.
        fit = 0.5 * likelihood.counted.sum(axis=1)
        measured = likelihood.measured[0].sum()
        state, found = self.weigh(state, misfit, fit, measured)
        info = _info_of_scan(scan, likelihood, state.log_weight, log_likelihood)
        return state, with_extra(info, "particles", found)

    def estimate(self, state: PoseParticles) -> Estimate:
        points = jnp.asarray(self.landmarks, state.pose.dtype)
        return self.pose_estimate(state, jax.vmap(self.sensor.position)(points), map_tags(self))


def _info_of_scan(
    scan: Scan,
    likelihood: ScanLikelihood,
    log_weight: Float[Array, "P"],
    log_likelihood: Float[Array, ""],
) -> Info:
    """The `Info` of the most likely particle, with the weighted mean NIS."""
    best = jnp.argmax(log_weight)
    one: ScanLikelihood = jax.tree.map(lambda of_all: of_all[best], likelihood)
    return info_of(
        status_of(scan.valid, matched=one.matched, positive=one.positive, inside=one.inside),
        one.matched,
        size=one.dof,
        slot=one.slot,
        nis=weighted_nis(likelihood.nis, likelihood.matched, log_weight),
        innovation=one.innovation,
        innovation_cov=one.innovation_cov,
        log_likelihood=log_likelihood,
        exhausted=likelihood.exhausted.any(),
    )
