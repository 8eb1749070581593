"""Monte-Carlo localization in an occupancy grid, from the beams of a laser."""

import math
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, PyTree

from jaxslam import validation
from jaxslam.core.numbers import is_concrete
from jaxslam.filters.particles.pose_steps import pose_filter, weigh_particles
from jaxslam.filters.particles.settings import (
    MonteCarloSettings,
    checked_box,
    checked_least,
)
from jaxslam.filters.particles.states.pose_state import (
    PoseParticles,
    active_mask,
    draw_start,
)
from jaxslam.filters.reporting import info_of, status_of, with_extra
from jaxslam.grids.beam_models.beam_model import BeamModel, log_likelihood
from jaxslam.grids.grid import Grid, check_grid, to_cells
from jaxslam.grids.localization.beam_log import BEAM, beams_of
from jaxslam.grids.localization.free_space import free_region
from jaxslam.math.arrays import in_dtype
from jaxslam.math.xla import no_inline
from jaxslam.protocols import Filter, Motion, Resample
from jaxslam.resampling.systematic import systematic
from jaxslam.resampling.weights import normalized
from jaxslam.types import Beams, Info, Scan
from jaxslam.validation.models import check_motion


def localize(
    grid: Grid,
    model: BeamModel,
    motion: Motion,
    particles: int,
    *,
    start: Literal["gaussian", "uniform"] = "gaussian",
    box: ArrayLike | None = None,
    exponent: ArrayLike = 0.1,
    every: int = 1,
    resample: Resample = systematic,
    threshold: float = 1.0,
    bins: tuple[float, float, float] = (0.5, 0.5, math.radians(15)),
    error: float = 0.05,
    confidence: float = 0.99,
    least: int | None = None,
    forget: tuple[float, float] | None = (0.01, 0.1),
    slack: float = 1.0,
) -> Filter:
    """Monte-Carlo localization in a grid: particles weighted by a beam model, KLD, recovery.

    `filters.particle_localization` with the beams of a laser in place of landmarks: the same
    motion, number of particles (Fox 2003) and resampling. It takes the log of `beam_log`. A weight
    is multiplied by

        (Π_k p(z_k | x, map))^exponent

    over the usable beams of the scan, each `every`-th. An exponent below 1 tempers the likelihood:
    beams are not independent given the pose, and without it the particles are overconfident
    (Thrun, Burgard & Fox 2005, "Probabilistic robotics", sections 6.3.4 and 8.3.4). Which exponent
    is honest depends on model, map and number of beams; `consistency.judge_localization` measures
    it.

    Recovery (table 8.3) compares the geometric mean of p(z_k) over the beams of a scan, averaged
    over the particles, with its long-term average, so the number of beams does not matter. It draws
    particles from the free cells of the map (in the box, if there is one) with any heading; so does
    a uniform start.

    The estimate is a single mean and covariance, also where the particles form several groups:
    `clusters` of `final.pose` and `final.log_weight` finds these. A particle off the map or in an
    occupied cell has weight zero; `blocked` of `info.extra["particles"]`, a `ParticleInfo`, counts
    those in use. A scan without a usable beam tells no more than that. The status of a beam is
    FUSED if it entered the weights, UNMATCHED if `every` left it out or the scan left no particle a
    weight (`underflow`), as where all are off the map. log_likelihood is
    log Σ w p(z | x)^exponent.

    Args:
        grid: a map with a free cell, outside a trace.
        model: as `likelihood_field` or `ray_cast`.
        motion: any; for odometry `motion.Odometry` with `odometry_controls`.
        particles: the capacity P, at least 1. Its cost is that of P · B/every look-ups a step.
        start: "gaussian", the pose and covariance given to `run` (the latter may be zero), or
            "uniform", anywhere free, whatever is given.
        box: (2, 2) the lowest and the highest (x, y) [m] where the robot may be; default the map.
        exponent: of the likelihood, above 0; differentiable.
        every: use each n-th beam, at least 1.
        resample, threshold, bins, error, confidence, least, forget, slack: as in
            `filters.particle_localization`.
    Raises:
        ValueError: a grid that is none or has no free cell (in the box), a model that is none,
            an exponent or a number out of range.
    """
    check_grid("localize", grid)
    if not is_concrete(grid):
        raise ValueError(
            "localize: expected a grid outside a trace, since its free cells are found"
        )
    if not isinstance(model, BeamModel):
        raise ValueError(f"localize: expected a BeamModel, got {type(model).__name__}")
    check_motion("localize", motion)
    validation.check_count("localize: every", every)
    if is_concrete(exponent) and not 0 < float(np.asarray(exponent)) < np.inf:
        raise ValueError(f"localize: expected an exponent above 0, got {exponent!r}")
    limits = checked_box("localize", box)
    settings = MonteCarloSettings(
        name="localize",
        motion=motion,
        particles=particles,
        region=free_region("localize", grid, limits),
        start=start,
        resample=resample,
        threshold=threshold,
        bins=bins,
        error=error,
        confidence=confidence,
        least=checked_least("localize", particles, least),
        rates=forget,
        slack=slack,
    )
    prepared = model.prepare(grid)

    def update(state: PoseParticles, scan: Scan, key: Array) -> tuple[PoseParticles, Info]:
        state, beams = draw_start(state, key, settings), beams_of(scan, every)

        def fit_of(poses: Float[Array, "P 3"], map_of: PyTree, beams: Beams) -> Float[Array, "P"]:
            one = partial(log_likelihood, model, map_of, beams=beams)
            return -jax.vmap(one)(poses)

        # Else XLA computes it again in each of its consumers.
        fit = no_inline(fit_of, state.pose, in_dtype(prepared, state.pose.dtype), beams)
        blocked = _blocked(grid, state.pose)
        fit = jnp.where(blocked, jnp.inf, fit)
        misfit = jnp.where(blocked, jnp.inf, jnp.asarray(exponent, fit.dtype) * fit)
        evidence = normalized(state.log_weight - misfit)[1]
        blocked = blocked & active_mask(state)
        state, found = weigh_particles(state, misfit, fit, beams.valid.sum(), settings)
        found = found._replace(blocked=blocked.sum(dtype=jnp.int32))
        info = info_of_beams(scan, every, evidence, ~found.underflow)
        return state, with_extra(info, "particles", found)

    def no_points(pose: Float[Array, "3"]) -> Float[Array, "0 2"]:
        return jnp.zeros((0, 2), pose.dtype)

    return pose_filter(settings, update, BEAM, no_points, np.zeros(0, np.int32))


def _blocked(grid: Grid, pose: Float[Array, "P 3"]) -> Bool[Array, "P"]:
    """Which poses are off the map or in an occupied cell."""
    height, width = grid.log_odds.shape
    at = jnp.floor(to_cells(jnp.asarray(grid.origin), grid.resolution, pose[:, :2]))
    inside = (at >= 0).all(axis=1) & (at[:, 0] < width) & (at[:, 1] < height)
    j, i = jnp.where(inside[:, None], at, 0.0).astype(jnp.int32).T
    return ~inside | (jnp.asarray(grid.log_odds > 0)[i, j])


def info_of_beams(
    scan: Scan, every: int, log_likelihood: Float[Array, ""], used: Bool[Array, ""]
) -> Info:
    """The `Info` of a scan: what became of each beam; a beam has no innovation.

    Each n-th beam is FUSED where the scan was used; all others are UNMATCHED.
    """
    m = scan.valid.shape[0]
    taken = (jnp.arange(m) % every == 0) & used
    kind = scan.z.dtype
    return info_of(
        status_of(scan.valid, matched=taken, inside=scan.z[:, 0] > 0),
        taken,
        size=0,
        slot=jnp.full(m, -1, jnp.int32),
        nis=jnp.zeros(m, kind),
        innovation=jnp.zeros((m, 0), kind),
        innovation_cov=jnp.zeros((m, 0, 0), kind),
        log_likelihood=log_likelihood.astype(kind),
    )
