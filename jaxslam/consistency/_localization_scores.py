"""Is a particle filter in a known map honest? Coverage, NEES, energy score, share of runs lost."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from jaxslam._driver import run
from jaxslam.consistency._intervals import LEVEL, Average, interval, positive_interval
from jaxslam.consistency._measures.nees import block_nees, pose_error
from jaxslam.core._reprs import short_repr
from jaxslam.core.protocols import Filter
from jaxslam.core.types import JaxOrNumPy, Log
from jaxslam.core.validation import (
    InvalidField,
    at_least,
    covariance,
    instance_of,
    prng_key,
    refusals_of,
    require,
)
from jaxslam.filters._particles.pose_particles import PoseParticles
from jaxslam.laser.grids._grid_localization import beam_log
from jaxslam.math._linalg import root_psd
from jaxslam.math.angles import wrap
from jaxslam.resampling._weights import at_points, weights_of
from jaxslam.simulation.laser import LaserWorld, scan_world

_DRAWS = 199
"""Draws from the particles in a step: with the truth 200 poses, so that levels are multiples of
0.5 %."""

NEAR = 0.5, np.deg2rad(30.0)
"""Distance [m] and turn [rad] from the mean within which 95 % of the weight must lie for a NEES."""

_KERNEL = 0.5
"""Width of the kernel of `covering_level` in standard deviations; for any width an honest filter's
level is uniform."""


class LocalizationScores(NamedTuple):
    """The estimates of a filter in each of R runs at T steps, and the truth."""

    truth: Float[JaxOrNumPy, "R T 3"]
    pose: Float[JaxOrNumPy, "R T 3"]
    """the estimate"""
    pose_cov: Float[JaxOrNumPy, "R T 3 3"]
    level: Float[JaxOrNumPy, "R T"]
    """level of the smallest set of the particles that covers the truth, see `covering_level`"""
    energy: Float[JaxOrNumPy, "R T"]
    """energy score of the position [m], see `energy_score`"""
    together: Bool[JaxOrNumPy, "R T"]
    """95 % of the weight lies near the mean: the particles are one group"""
    ess: Float[JaxOrNumPy, "R T"]
    active: Int[JaxOrNumPy, "R T"]

    def __repr__(self) -> str:
        return short_repr(self)


class LocalizationSummary(NamedTuple):
    """Averages over the runs, with 95 % intervals from the spread between runs."""

    coverage: Average | None
    """share of the steps in which the 95 % set of the particles covers the truth"""
    nees: Average | None
    """mean pose NEES where the particles are one group; 3 is honest; None where they never are"""
    unimodal: float
    """share of the steps in which the particles are one group"""
    energy: Average | None
    """mean energy score of the position [m]: less is better"""
    rmse: Average | None
    """position RMSE [m] of the runs that are not lost"""
    heading: float
    """median size of the heading error [rad] of the runs that are not lost"""
    converged_at: Float[np.ndarray, "R"]
    """the step from which the error stays below the limit; inf for a run that is lost"""
    lost: float
    """share of the runs that are lost"""
    not_finite: int = 0
    """number of the runs with a NaN or ∞ in a step: no set covers the truth there, a run that ends
    so is lost, and `energy` and `rmse` are of the other runs"""

    @property
    def doubts(self) -> tuple[str, ...]:
        """Sentences that qualify the averages; () if nothing does."""
        if not self.not_finite:
            return ()
        runs = len(self.converged_at)
        return (
            f"not finite (NaN or ∞) in {self.not_finite:,} of {runs:,} runs: the energy score and "
            "the RMSE are of the others",
        )


def judge_localization(
    world: LaserWorld,
    filter: Filter,
    runs: int,
    key: Array,
    *,
    start_cov: ArrayLike = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    same_log: bool = False,
    stride: int = 1,
) -> LocalizationScores:
    """The scores of a filter over many draws of a laser world; the same key gives the same draws.

    The filter starts at a pose drawn from N(true start, start_cov), with that covariance. Runs go
    one after the other in one program.

    Args:
        filter: of `grids.GridLocalization`.
        start_cov: (3, 3), which may be zero.
        same_log: one history for all runs, which differ only in the draws of the filter.
        stride: scores are computed at each n-th step, from the n-th on.
    Raises:
        ValueError: a world, a filter, a key, a covariance or a number that is none.
    """
    with refusals_of("judge_localization"):
        require("world", world, instance_of(LaserWorld))
        require("filter", filter, instance_of(Filter))
        require("runs", runs, at_least(1))
        require("stride", stride, at_least(1))
        if stride > (steps := len(np.asarray(world.controls))):
            raise InvalidField("stride", f"expected at most the {steps} steps, got {stride}")
        require("key", key, prng_key)
        require("start_cov", start_cov, covariance(3))
    key_log, key_start, key_filter = jax.random.split(key, 3)
    logs = jnp.broadcast_to(key_log, (runs, *key_log.shape)) if same_log else None
    keys = (
        jax.random.split(key_log, runs) if logs is None else logs,
        jax.random.split(key_start, runs),
        jax.random.split(key_filter, runs),
    )
    scores: LocalizationScores = _judge(world, filter, stride, keys, np.asarray(start_cov, float))
    return scores


@partial(jax.jit, static_argnames="stride", inline=True)
def _judge(
    world: LaserWorld,
    filter: Filter,
    stride: int,
    keys: tuple[Array, Array, Array],
    start_cov: Array,
) -> LocalizationScores:
    def score_run(keys: tuple[Array, Array, Array]) -> LocalizationScores:
        history = scan_world(world, keys[0])
        dtype = history.pose.dtype
        root = root_psd(start_cov.astype(dtype))
        offset = root @ jax.random.normal(keys[1], (3,), dtype)
        start = jnp.asarray(world.pose, dtype) + offset
        log = beam_log(history.control, history.beams)
        return score_localization(
            filter, log, history.pose, start, start_cov.astype(dtype), keys[2], stride=stride
        )

    scores: LocalizationScores = jax.lax.map(score_run, keys)
    return scores


def score_localization(
    filter: Filter,
    log: Log,
    truth: Float[Array, "T 3"],
    pose: ArrayLike,
    pose_cov: ArrayLike,
    key: Array,
    *,
    stride: int = 1,
) -> LocalizationScores:
    """The scores of one run, without the leading R; traceable: `jax.lax.map` it over keys.

    Args:
        filter: whose state is a `PoseParticles`, as of `grids.GridLocalization`.
        log, pose, pose_cov: as `run` takes them. truth: true poses.
        stride: score each n-th step, from the n-th on.
    """
    key_run, key_draw = jax.random.split(key)

    def kept(state: PoseParticles) -> tuple[Array, Array]:
        return state.pose, state.log_weight

    trace = run(filter, log, pose, pose_cov, key_run, probe=kept)
    particles = trace.info.extra["particles"]  # type: ignore[index]
    scored = (truth, trace.estimate.pose, trace.estimate.pose_cov, trace.probe)
    scored, ess, active = jax.tree.map(
        lambda leaf: leaf[stride - 1 :: stride], (scored, particles.ess, particles.active)
    )
    true, mean, cov, (poses, log_weights) = scored
    keys = jax.random.split(key_draw, len(true))

    def score_step(row: tuple[Array, ...]) -> tuple[Array, Array, Array]:
        true, mean, poses, log_weights, key = row
        weights = weights_of(log_weights)
        draws = poses[at_points(weights, jax.random.uniform(key, (_DRAWS,), weights.dtype))]
        off = jnp.hypot(*(poses[:, :2] - mean[None, :2]).T)
        near = (off < NEAR[0]) & (jnp.abs(wrap(poses[:, 2] - mean[2])) < NEAR[1])
        together = (weights * near).sum() >= 0.95
        return covering_level(draws, true), energy_score(draws[:, :2], true[:2]), together

    level, energy, together = jax.lax.map(score_step, (true, mean, poses, log_weights, keys))
    return LocalizationScores(true, mean, cov, level, energy, together, ess, active)


def covering_level(draws: Float[Array, "S 3"], truth: Float[Array, "3"]) -> Float[Array, ""]:
    """The level of the smallest set of a sample of poses that covers the truth, in (0, 1].

    Of an honest filter the truth is one more draw. So all S + 1 poses are ranked by a density that
    treats them alike, the mean of Gaussian kernels at the others, of `_KERNEL` standard deviations
    of all S + 1 in x, y and θ: the level is the share of them that are as dense as the truth or
    denser. It is uniform on 1/(S+1), …, 1 if the truth is distributed as the draws, whatever that
    distribution and the kernel. The 95 % set covers the truth where the level is at most 0.95.
    Copies of a draw, from resampling, are left out of its mean.
    """
    points = jnp.concatenate([truth[None], draws])
    count = len(points)
    d = points[:, None] - points[None]
    d = jnp.concatenate([d[..., :2], wrap(d[..., 2:])], axis=-1)
    variance = (d * d).sum(axis=(0, 1)) / (2 * count * (count - 1))
    scale = jnp.where(variance > 0, variance, 1.0)[None, None]
    scaled = (d * d / scale).sum(axis=-1)
    distinct = scaled > 0
    kernels = jnp.where(distinct, jnp.exp(-0.5 * scaled / _KERNEL**2), 0.0).sum(axis=1)
    density = kernels / jnp.maximum(distinct.sum(axis=1), 1)
    # Rounding of sums of so many terms must not break a tie, as in a sample of one point.
    rounding = count * float(jnp.finfo(density.dtype).eps)
    return (density >= density[0] * (1 - rounding)).sum() / count


def energy_score(draws: Float[Array, "S D"], truth: Float[Array, "D"]) -> Float[Array, ""]:
    """The energy score mean |x_i - y| - ½ mean |x_i - x_j|, i ≠ j, of particles x; less is better.

    Its expectation is least for the true distribution, and for one that knows nothing it is as
    large as the mean error: Gneiting & Raftery 2007, "Strictly proper scoring rules, prediction,
    and estimation", JASA 102.
    """
    count = len(draws)
    error = jnp.sqrt(((draws - truth[None]) ** 2).sum(axis=-1)).mean()
    square = ((draws[:, None] - draws[None]) ** 2).sum(axis=-1)
    apart = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
    return error - 0.5 * apart.sum() / (count * (count - 1))


def summarize_localization(
    scores: LocalizationScores, *, skip: int = 0, limit: tuple[float, float] = (0.5, np.pi / 6)
) -> LocalizationSummary:
    """The averages of scores over the runs.

    A run has converged at the step from which the errors stay below a limit to the end; without
    such a step it is lost.

    Args:
        skip: steps at the beginning that no average counts.
        limit: of the position [m] and the heading [rad].
    Raises:
        ValueError: no step is left.
    """
    scores = LocalizationScores(*(np.asarray(part) for part in scores))
    steps = scores.level.shape[1]
    if not 0 <= skip < steps:
        raise InvalidField(
            "skip",
            f"expected a number from 0 to {steps - 1}, got {skip}",
            owner="summarize_localization",
        )
    error = pose_error(scores.truth, scores.pose)  # type: ignore[arg-type]
    off = np.hypot(error[..., 0], error[..., 1])
    numbers = scores.pose, scores.pose_cov, scores.level, scores.energy
    finite = np.stack([np.isfinite(n).reshape(*off.shape, -1).all(axis=-1) for n in numbers]).all(0)
    near = (off < limit[0]) & (np.abs(error[..., 2]) < limit[1])
    wrong = ~(near & finite)
    last = np.where(wrong.any(axis=1), steps - np.argmax(wrong[:, ::-1], axis=1), 0)
    converged_at = np.where(last < steps, last, np.inf)
    kept = np.isfinite(converged_at)
    counted_steps = slice(skip, None)
    nees = block_nees(scores.pose, error, error, scores.pose_cov)["pose"]  # type: ignore[arg-type]
    counted = (nees.regular & scores.together)[:, counted_steps]
    per_run = np.where(counted, nees.value[:, counted_steps], 0.0).sum(axis=1) / np.maximum(
        counted.sum(axis=1), 1
    )
    rmse = np.sqrt((off[kept, counted_steps] ** 2).mean(axis=1))
    covers = finite & (np.asarray(scores.level) <= 0.95 + 1e-9)
    energy = np.where(finite, scores.energy, np.nan)[:, counted_steps].mean(axis=1)
    return LocalizationSummary(
        coverage=interval(covers[:, counted_steps].mean(axis=1), LEVEL),
        nees=positive_interval(np.where(counted.any(axis=1), per_run, np.nan), LEVEL),
        unimodal=float(scores.together[:, counted_steps].mean()),
        energy=positive_interval(energy, LEVEL),
        rmse=positive_interval(rmse, LEVEL),
        heading=float(np.median(np.abs(error[kept, counted_steps, 2]))) if kept.any() else np.nan,
        converged_at=converged_at,
        lost=float(1 - kept.mean()),
        not_finite=int((~finite.all(axis=1)).sum()),
    )


def seed_spread(scores: LocalizationScores) -> Float[np.ndarray, "T"]:
    """The spread of runs on one log relative to the claimed one: the mean over x, y and θ of the
    variance of the estimate between the runs over the mean claimed variance.

    0 for a filter without draws. From `judge_localization(…, same_log=True)`.
    """
    pose, cov = np.asarray(scores.pose), np.asarray(scores.pose_cov)
    middle = np.broadcast_to(pose[:1], pose.shape)
    off = pose_error(pose, middle)  # around the first, wrapped
    claimed = np.diagonal(cov, axis1=2, axis2=3).mean(axis=0)
    ratio = off.var(axis=0, ddof=1) / np.where(claimed > 0, claimed, np.nan)
    return np.asarray(np.nanmean(ratio, axis=1))
