"""Rao-Blackwellized SLAM with a grid a particle: FastSLAM's idea on occupancy grids."""

import math
from collections.abc import Callable
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, Int, PyTree

from jaxslam import validation
from jaxslam.charts.euclidean import euclidean
from jaxslam.filters.particles.proposal import sample_motion
from jaxslam.filters.particles.settings import check_resampling
from jaxslam.filters.particles.states.moments import weighted_pose_moments
from jaxslam.filters.particles.states.particle_info import ParticleInfo
from jaxslam.filters.particles.states.pose_state import draw_gaussian_poses
from jaxslam.filters.reporting import with_extra
from jaxslam.grids.beam_models.beam_model import BeamModel, log_likelihood
from jaxslam.grids.grid import Grid, check_frame, to_cells
from jaxslam.grids.localization.beam_log import BEAM, beams_of
from jaxslam.grids.localization.localize import info_of_beams
from jaxslam.grids.mapping import Counts, add_scan, check_hit_and_miss, check_shape, occupancy
from jaxslam.grids.slam.particles import GridParticles, MapInfo, copied_rows, in_place
from jaxslam.grids.slam.proposal import propose
from jaxslam.math import se2
from jaxslam.protocols import Filter, Motion, Resample
from jaxslam.resampling.systematic import systematic
from jaxslam.resampling.weights import effective_size, normalized
from jaxslam.types import Beams, Estimate, Info, Scan
from jaxslam.validation.numbers import check_mount, check_positive


def grid_slam(
    shape: tuple[int, int],
    origin: ArrayLike,
    resolution: ArrayLike,
    model: BeamModel,
    motion: Motion,
    particles: int,
    *,
    max_range: float,
    no_return: float = 0.0,
    mount: ArrayLike | tuple[float, ...] = (0.0, 0.0, 0.0),
    proposal: Literal["motion", "scan_matched"] = "scan_matched",
    candidates: int = 16,
    iterations: int = 20,
    spread: tuple[float, float] = (0.05, 0.02),
    exponent: ArrayLike = 0.1,
    every: int = 1,
    hit: ArrayLike = 0.7,
    miss: ArrayLike = 0.4,
    resample: Resample = systematic,
    threshold: float = 0.5,
) -> Filter:
    """Rao-Blackwellized grid SLAM: weighted paths, and for each path the map at known poses.

    Given a path, cells are independent and the map is `count` of the scans along it (Murphy 1999,
    "Bayesian map learning in dynamic environments"; Hähnel, Burgard, Fox & Thrun 2003). The state
    is a `GridParticles`; it takes the log of `beam_log`. The pose before the first control is the
    frame of the maps.

    "motion": poses are drawn from the motion with its noise, and weighted by
    p(z | x, map)^exponent, the scan in the particle's own map so far. "scan_matched": poses are
    drawn near the best match of the scan, as `proposal.propose` says, with the scan marginal over
    the motion as weight (Grisetti, Stachniss & Burgard 2007).

    Then each map counts the scan from its own pose, all beams of it. Particles are resampled before
    a motion, if the last scan left ESS = 1/Σ w² below threshold · P. Survivors stay in their place:
    only maps of particles that died are overwritten, in a loop of as many copies.

    `info.extra["particles"]` is a `ParticleInfo`, and `info.extra["maps"]` a `MapInfo`: how many
    maps were copied, and how many particles are off their map, whose scan is not counted. The
    status of a beam is FUSED if it entered the weights, UNMATCHED if `every` left it out, the scan
    left no particle a weight, or all particles are off their maps. The estimate is
    `weighted_pose_moments` of the particles, without landmarks; `best_map(trace.final)` is the map.

    A step costs P · B · (2 W · iterations + candidates) look-ups and P distance fields of the whole
    map, and the state has 8 P H W bytes: it is meant for a room. The maps are overconfident as all
    counts are, and so is the covariance, as of `fastslam`: after a resampling particles share their
    past.

    Args:
        shape: (H, W) of the maps. origin, resolution: as in `Grid`.
        model: as `likelihood_field`; what it prepares of a map is made in every step, so `ray_cast`
            costs much more.
        motion: any.
        particles: P, at least 1.
        max_range: of the laser [m]. no_return, mount: as of `count`.
        candidates: K poses a particle, even. iterations: of the search for a match.
        spread: widths [m], [rad] of the candidates about a match, if the motion is wider.
        exponent: of the likelihood, above 0; beams are not independent. every: each n-th beam
            enters the weight.
        hit, miss: of `occupancy`, for the maps that scans are compared with.
        resample: one of `jaxslam.resampling` that returns ancestors.
        threshold: of ESS, as a share of P; 0 never resamples.
    Raises:
        ValueError: on a frame, a mount or a model that is none, and numbers out of range.
    """
    name = "grid_slam"
    check_shape(name, shape)
    check_frame(name, origin, resolution)
    check_mount(name, mount)
    check_hit_and_miss(name, hit, miss)
    if not isinstance(model, BeamModel):
        raise ValueError(f"{name}: expected a BeamModel, got {type(model).__name__}")
    validation.check_motion(name, motion)
    for what, count in (("particles", particles), ("every", every), ("iterations", iterations)):
        validation.check_count(f"{name}: {what}", count)
    if particles * shape[0] * shape[1] >= 2**31:
        raise ValueError(
            f"{name}: expected fewer than 2^31 cells in all {particles} maps, got {shape}"
        )
    if candidates < 2 or candidates % 2:
        raise ValueError(
            f"{name}: expected an even number of candidates, at least 2, got {candidates}"
        )
    if proposal not in ("motion", "scan_matched"):
        raise ValueError(f'{name}: expected proposal "motion" or "scan_matched", got {proposal!r}')
    check_positive(name, max_range=max_range, exponent=exponent)
    if not 0 <= no_return <= max_range:
        raise ValueError(f"{name}: expected no_return from 0 to {max_range}, got {no_return}")
    concrete = validation.is_concrete(spread)
    if validation.shape_told(spread if concrete else jnp.asarray(spread)) != "(2,)" or (
        concrete and not min(spread) > 0
    ):
        raise ValueError(f"{name}: expected a spread of two widths above 0, got {spread!r}")
    check_resampling(name, resample, threshold)
    height, width = shape

    def init(pose: Float[Array, "3"], pose_cov: Float[Array, "3 3"]) -> GridParticles:
        kind, no = pose.dtype, jnp.asarray(False)
        counts = jnp.zeros((particles, height, width), jnp.int32)
        return GridParticles(
            pose=jnp.broadcast_to(pose, (particles, 3)),
            log_weight=jnp.full(particles, -math.log(particles), kind),
            best=jnp.zeros((), jnp.int32),
            hits=counts,
            misses=counts,
            origin=jnp.asarray(origin, kind),
            resolution=jnp.asarray(resolution, kind),
            control=jnp.zeros(len(motion.controls), kind),
            pending=no,
            due=no,
            start_cov=pose_cov,
            copied=jnp.zeros((), jnp.int32),
        )

    def predict(state: GridParticles, u: Float[Array, "U"], key: Array) -> GridParticles:
        key_resample, key_start, key_motion = jax.random.split(key, 3)
        pose = draw_gaussian_poses(state.pose, state.start_cov, key_start)
        unseen = sample_motion(motion, pose, state.control, key_motion)  # no scan since
        pose = jnp.where(
            state.pending & jnp.isfinite(unseen).all(axis=1, keepdims=True), unseen, pose
        )
        slot = jnp.arange(particles, dtype=jnp.int32)
        ancestor = resample(state.log_weight, key_resample).astype(jnp.int32)
        source = jnp.where(state.due, in_place(ancestor), slot)
        hits, misses = copied_rows((state.hits, state.misses), source)
        even = jnp.full_like(state.log_weight, -math.log(particles))
        return state._replace(
            pose=pose[source],
            log_weight=jnp.where(state.due, even, state.log_weight),
            hits=hits,
            misses=misses,
            control=u,
            pending=jnp.asarray(True),
            start_cov=jnp.zeros_like(state.start_cov),
            copied=(source != slot).sum(dtype=jnp.int32),
        )

    def fits(state: GridParticles, beams: Beams) -> tuple[PyTree, Callable[[PyTree, Array], Array]]:
        """What the model makes of each map, and the tempered log-likelihood of the scan in it."""
        maps = _occupancy(state, hit, miss)

        def prepare(log_odds: Array) -> PyTree:
            return model.prepare(Grid(log_odds, state.origin, state.resolution))

        def fit(prepared: PyTree, pose: Array) -> Array:
            return jnp.asarray(exponent, pose.dtype) * log_likelihood(model, prepared, pose, beams)

        return jax.vmap(prepare)(maps), fit

    def update(state: GridParticles, scan: Scan, key: Array) -> tuple[GridParticles, Info]:
        beams = beams_of(scan, every)
        prepared, fit = fits(state, beams)
        key_motion, key_near = jax.random.split(key)
        moved = sample_motion(motion, state.pose, state.control, key_motion)
        if proposal == "motion":
            weight = jax.vmap(fit)(prepared, moved)
        else:

            def each(prepared: PyTree, pose: Array, key: Array) -> tuple[Array, Array]:
                return propose(
                    partial(fit, prepared),
                    motion,
                    pose,
                    state.control,
                    key,
                    candidates=candidates,
                    iterations=iterations,
                    spread=spread,
                )

            keys, seen = jax.random.split(key_near, particles), beams.valid.any()
            near, weight = jax.vmap(each)(prepared, state.pose, keys)
            moved = jnp.where(seen, near, moved)
            weight = jnp.where(seen, weight, 0.0)
        moved = jnp.where(state.pending, moved, state.pose)
        good = jnp.isfinite(moved).all(axis=1)
        pose = jnp.where(good[:, None], moved, state.pose)
        log_weight, evidence, some = normalized(
            state.log_weight + jnp.where(good, weight, -jnp.inf)
        )
        hits, misses, outside = _counted(state, pose, scan)
        ess = effective_size(log_weight)
        due = ess < threshold * particles
        found = ParticleInfo(
            ess=ess,
            resampled=state.copied > 0,
            underflow=~some,
            invalid=(~good).sum(dtype=jnp.int32),
        )
        used = some & ~outside.all()
        info = with_extra(info_of_beams(scan, every, evidence, used), "particles", found)
        info = with_extra(info, "maps", MapInfo(state.copied, outside.sum(dtype=jnp.int32)))
        state = state._replace(
            pose=pose,
            log_weight=log_weight,
            best=jnp.argmax(log_weight).astype(jnp.int32),
            hits=hits,
            misses=misses,
            pending=jnp.asarray(False),
            due=due,
        )
        return state, info

    def _counted(
        state: GridParticles, pose: Array, scan: Scan
    ) -> tuple[Array, Array, Bool[Array, "P"]]:
        at = jnp.asarray(mount, pose.dtype)
        eyes = jax.vmap(se2.compose, (0, None))(pose, at)
        hits, misses, _ = add_scan(
            state.hits.reshape(-1),
            state.misses.reshape(-1),
            (height, width),
            state.origin,
            state.resolution,
            eyes,
            beams_of(scan, 1),
            max_range,
            no_return,
        )
        cell = to_cells(state.origin, state.resolution, eyes[:, :2])
        inside = (cell >= 0).all(axis=1) & (cell[:, 0] < width) & (cell[:, 1] < height)
        return hits.reshape(state.hits.shape), misses.reshape(state.misses.shape), ~inside

    def estimate(state: GridParticles) -> Estimate:
        still = jnp.zeros(len(motion.noises), state.pose.dtype)
        ahead = jax.vmap(motion.step, (0, None, None))(state.pose, state.control, still)
        pose = jnp.where(state.pending, ahead, state.pose)
        mean, cov = weighted_pose_moments(pose, state.log_weight, state.best)
        none = jnp.zeros((0, 2), mean.dtype)
        return Estimate(
            pose=mean,
            pose_cov=cov + state.start_cov,
            points=none,
            point_covs=jnp.zeros((0, 2, 2), mean.dtype),
            alive=jnp.zeros(0, bool),
            tag=jnp.zeros(0, jnp.int32),
        )

    return Filter(
        name=name,
        controls=motion.controls,
        measurements=BEAM,
        init=init,
        predict=predict,
        update=update,
        estimate=estimate,
        chart=euclidean(),
    )


def _occupancy(state: GridParticles, hit: ArrayLike, miss: ArrayLike) -> Float[Array, "P H W"]:
    """The log-odds of all maps."""
    none: Int[Array, ""] = jnp.zeros((), jnp.int32)
    counts = Counts(state.hits, state.misses, state.origin, state.resolution, none, none)
    return jnp.asarray(occupancy(counts, hit=hit, miss=miss).log_odds, state.pose.dtype)
