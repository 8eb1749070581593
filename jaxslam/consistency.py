"""Is a filter honest? NEES, NIS and their bands, from sums that a campaign streams.

A run's error is compared with the covariance the filter claims for it. With e = truth - estimate,
heading wrapped, NEES = eᵀ P⁻¹ e has mean dof for an honest filter (3 pose, 2 position, 1 heading);
it is *not* divided by dof anywhere here. Above is optimism, below pessimism. While P is singular
(a start with P0 = 0) there is no NEES: such steps are left out, and counted, never filled with 0.
(Bar-Shalom, Li, Kirubarajan 2001, 5.4; Bailey et al. 2006.)
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats

from jaxslam import se2
from jaxslam.angles import wrap
from jaxslam.linalg import mahalanobis_squared
from jaxslam.protocols import Sensor
from jaxslam.stats import chi2_quantile, t_quantile
from jaxslam.types import Estimate, Status, Trace, Truth

DOF = {"pose": 3, "position": 2, "heading": 1}
"""Blocks of the pose error whose NEES is taken, and the mean of an honest one."""

LEVEL = 0.95
"""of every band and interval."""

DROPS = (
    Status.REJECTED,
    Status.OVERFLOW,
    Status.DEFERRED,
    Status.REPEATED,
    Status.SINGULAR,
)
"""What can keep a measurement from the map; each is counted."""


class Sums(NamedTuple):
    """Everything that leaves a run, or, added up, a block of runs, or a campaign."""

    finite: Any
    """() runs whose every number is finite; the others add to nothing but `not_finite`."""
    not_finite: Any
    """()"""
    divergent: Any
    """() finite runs that end too far from the truth."""
    curves: dict[str, Any]
    """(T,) sums over runs: nees_*, regular_* (runs with a NEES at that step), square errors, nis,
    nis_dof."""
    measures: dict[str, tuple[Any, Any, Any]]
    """Σ m, Σ m², runs, of each run's own time averages."""
    drops: dict[str, Any]
    """() measurements by what became of them, and `missed`."""


def score(trace: Trace, truth: Truth, sensor: Sensor, limit: jax.Array) -> Sums:
    """One run's share of the sums. limit () [m]: a final position error above is divergence."""
    error = truth.pose - trace.estimate.pose
    error = jnp.concatenate([error[:, :2], wrap(error[:, 2:])], axis=1)
    cov = trace.estimate.pose_cov
    curves: dict[str, jax.Array] = {}
    measures: dict[str, tuple[jax.Array, jax.Array]] = {}
    variance = jnp.diagonal(cov, axis1=1, axis2=2)
    metres = jnp.sqrt(jnp.maximum(variance[:, :2].max(axis=1), 0.0))
    scale = jnp.stack([metres, metres, jnp.sqrt(jnp.maximum(variance[:, 2], 0.0))], axis=1)
    for block, at in (("pose", slice(0, 3)), ("position", slice(0, 2)), ("heading", slice(2, 3))):
        nees, regular = jax.vmap(mahalanobis_squared)(error[:, at], cov[:, at, at], scale[:, at])
        curves[f"nees_{block}"], curves[f"regular_{block}"] = nees, regular.astype(nees.dtype)
        measures[f"nees_{block}"] = nees.sum(), regular.sum()
    steps = error.shape[0]
    curves["square_position"] = (error[:, :2] ** 2).sum(axis=1)
    curves["square_heading"] = error[:, 2] ** 2
    fused = trace.info.status == Status.FUSED
    curves["nis"] = jnp.where(fused, trace.info.nis, 0.0).sum(axis=1)
    curves["nis_dof"] = trace.info.dof.sum(axis=1).astype(error.dtype)
    measures["square_position"] = curves["square_position"].sum(), jnp.asarray(steps)
    measures["square_heading"] = curves["square_heading"].sum(), jnp.asarray(steps)
    measures["nis_per_dof"] = curves["nis"].sum(), curves["nis_dof"].sum()
    square, count = _landmark_error(trace, truth, sensor)
    measures["square_landmarks"] = square, count
    measures["log_likelihood"] = trace.info.log_likelihood.sum(), jnp.asarray(1)

    drops = {s.name.lower(): (trace.info.status == s).sum() for s in DROPS}
    drops |= {"missed": truth.missed.sum(), "singular_steps": (curves["regular_pose"] == 0).sum()}
    finite = jnp.asarray(True)
    for leaf in jax.tree.leaves((trace.estimate, trace.info, curves)):
        finite = finite & jnp.all(jnp.isfinite(leaf))
    far = jnp.sqrt(curves["square_position"][-1]) > limit

    def kept(value: jax.Array) -> jax.Array:
        return jnp.where(finite, value, jnp.zeros_like(value))

    moments = {}
    for name, (total, weight) in measures.items():
        defined = finite & (weight > 0)
        mean = jnp.where(defined, total / jnp.maximum(weight, 1), 0.0)
        moments[name] = mean, mean**2, defined.astype(error.dtype)
    return Sums(
        finite=finite.astype(error.dtype),
        not_finite=(~finite).astype(error.dtype),
        divergent=(finite & far).astype(error.dtype),
        curves=jax.tree.map(kept, curves),
        measures=moments,
        drops=jax.tree.map(kept, drops),
    )


def _landmark_error(trace: Trace, truth: Truth, sensor: Sensor) -> tuple[jax.Array, jax.Array]:
    """Σ |p̂ - p|² over the final map, in the map frame, unaligned, and the landmarks in it."""
    estimate = jax.tree.map(lambda leaf: leaf[-1], trace.estimate)
    named = estimate.alive & (estimate.tag >= 0)
    true_points = jax.vmap(sensor.position)(truth.landmarks)[jnp.maximum(estimate.tag, 0)]
    square = ((estimate.points - true_points) ** 2).sum(axis=1)
    return jnp.where(named, square, 0.0).sum(), named.sum()


def align_map(estimate: Estimate, true_points: np.ndarray) -> tuple[np.ndarray, float]:
    """The pose (3,) that carries a map onto surveyed points best, and the RMSE [m] it leaves.

    estimate: of one time, landmarks tagged; true_points (N, 2) by tag. The frame of a map made from
    data is that of the robot's start, so only its shape can be compared (`se2.align`). Raises
    ValueError if the map is empty.
    """
    named = np.asarray(estimate.alive) & (np.asarray(estimate.tag) >= 0)
    if not named.any():
        raise ValueError("align_map: the map holds no tagged landmark")
    points = jnp.asarray(estimate.points)[named]
    targets = jnp.asarray(true_points, points.dtype)[np.asarray(estimate.tag)[named]]
    pose = se2.align(points, targets)
    left = jax.vmap(se2.from_frame, (None, 0))(pose, points) - targets
    return np.asarray(pose), float(jnp.sqrt((left**2).sum(axis=1).mean()))


class Measure(NamedTuple):
    """A figure over all runs, with its 95 % interval from the spread between runs."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Summary:
    """What a campaign says of one filter."""

    verdict: str
    """consistent, optimistic, pessimistic, diverged or undecided; see `judge`."""
    measures: dict[str, Measure]
    """nees_pose (dof 3), nees_position (2), nees_heading (1), none divided by dof; nis_per_dof
    (1 is honest); rmse_position [m], rmse_heading_deg [°], rmse_landmarks [m] (final map,
    unaligned); log_likelihood (mean a run). Names without a number (nothing to average) are absent.
    """
    nis_band: tuple[float, float] | None
    """95 % band of nis_per_dof from the summed degrees of freedom; None without a measurement."""
    inside: dict[str, float]
    """share of steps whose average NEES lies in its band, by block; 0.95 is honest."""
    curves: dict[str, np.ndarray]
    """(T,) averages over runs: nees_* with *_low and *_high bands (NaN where no run has one),
    rmse_position, rmse_heading_deg, nis_per_dof, and runs_* that count."""
    counts: dict[str, int]
    """runs (finite), not_finite, divergent, singular_steps, and dropped measurements by reason."""


def summarize(sums: Sums) -> Summary:
    """Averages, bands and verdict from the sums of a campaign (host numbers, float64)."""
    runs = int(sums.finite)
    curves: dict[str, np.ndarray] = {}
    inside: dict[str, float] = {}
    for block, dof in DOF.items():
        count = np.asarray(sums.curves[f"regular_{block}"], np.float64)
        mean = _ratio(sums.curves[f"nees_{block}"], count)
        low, high = _bands(count, dof)
        curves |= {f"nees_{block}": mean, f"nees_{block}_low": low, f"nees_{block}_high": high}
        curves[f"runs_{block}"] = count
        has = count > 0
        if has.any():
            inside[block] = float(np.mean((mean >= low)[has] & (mean <= high)[has]))
    everyone = np.full(len(curves["nees_pose"]), float(runs))
    curves["rmse_position"] = np.sqrt(_ratio(sums.curves["square_position"], everyone))
    curves["rmse_heading_deg"] = np.rad2deg(
        np.sqrt(_ratio(sums.curves["square_heading"], everyone))
    )
    curves["nis_per_dof"] = _ratio(sums.curves["nis"], np.asarray(sums.curves["nis_dof"]))

    measures: dict[str, Measure] = {}
    for name, moments in sums.measures.items():
        measure = _interval(*(float(part) for part in moments))
        if measure is not None:
            measures |= _as_reported(name, measure)
    total_dof = float(np.sum(sums.curves["nis_dof"]))
    nis_band = None
    if total_dof > 0:
        measures["nis_per_dof"] = measures["nis_per_dof"]._replace(
            value=float(np.sum(sums.curves["nis"])) / total_dof
        )
        tail = (1 - LEVEL) / 2
        nis_band = (
            chi2_quantile(tail, total_dof) / total_dof,
            chi2_quantile(1 - tail, total_dof) / total_dof,
        )
    counts = {"runs": runs, "not_finite": int(sums.not_finite), "divergent": int(sums.divergent)}
    counts |= {name: int(count) for name, count in sums.drops.items()}
    return Summary(judge(measures, counts), measures, nis_band, inside, curves, counts)


def judge(measures: dict[str, Measure], counts: dict[str, int]) -> str:
    """The verdict, from the time-averaged NEES of the pose; errors in (x, y, θ), dof 3.

    Each run gives one time average, and runs are independent, so their mean has a t interval
    although NEES is correlated in time. consistent: 3 lies in the 95 % interval; optimistic: the
    interval lies above 3; pessimistic: below. diverged: over half of the runs are not finite or
    divergent. undecided: under two runs have a NEES.
    """
    lost = counts["not_finite"] + counts["divergent"]
    if lost > 0.5 * (counts["runs"] + counts["not_finite"]):
        return "diverged"
    nees = measures.get("nees_pose")
    if nees is None or not np.isfinite(nees.low):
        return "undecided"
    if nees.low > DOF["pose"]:
        return "optimistic"
    return "pessimistic" if nees.high < DOF["pose"] else "consistent"


def _interval(total: float, squares: float, count: float) -> Measure | None:
    if count == 0:
        return None
    mean = total / count
    if count < 2:
        return Measure(mean, -np.inf, np.inf)
    variance = max(squares - count * mean**2, 0.0) / (count - 1)
    half = t_quantile(0.5 + LEVEL / 2, int(count) - 1) * np.sqrt(variance / count)
    return Measure(mean, mean - half, mean + half)


def _as_reported(name: str, measure: Measure) -> dict[str, Measure]:
    """Mean squares become root mean squares, radians degrees; an interval's ends go along."""
    kind, _, what = name.partition("_")
    if kind != "square":
        return {name: measure}
    low, high = max(measure.low, 0.0), measure.high
    roots = np.sqrt([measure.value, low, high])
    if what == "heading":
        return {"rmse_heading_deg": Measure(*np.rad2deg(roots).tolist())}
    return {f"rmse_{what}": Measure(*roots.tolist())}


def _ratio(total: Any, count: np.ndarray) -> np.ndarray:
    safe = np.where(count > 0, count, 1.0)
    return np.where(count > 0, np.asarray(total, np.float64) / safe, np.nan)


def _bands(count: np.ndarray, dof: int) -> tuple[np.ndarray, np.ndarray]:
    """Two-sided chi-square band of the mean of count χ²_dof variables, step by step."""
    tail = (1 - LEVEL) / 2
    safe = np.maximum(count, 1)
    edges = [scipy.stats.chi2.ppf(p, dof * safe) / safe for p in (tail, 1 - tail)]
    low, high = (np.where(count > 0, edge, np.nan) for edge in edges)
    return low, high
