"""The scores of runs: the numbers of each run that a campaign adds up or keeps.

`run_statistics` takes sums over one run's maps and innovations, in JAX; `campaign._block_programs`
compiles it. `score` takes them, and the poses and infos of many runs, to the measures of each run;
`tally.condense` takes what that returns.

A run's error is compared with the covariance the filter claims for it. With e = truth - estimate,
heading wrapped, NEES = eᵀ P⁻¹ e has mean dof for an honest filter; it is *not* divided by dof
anywhere here. While P is singular (a start with P0 = 0, or a deviation that is rounding; see
`block_nees`) there is no NEES: such steps are left out, and counted, never filled with 0.
(Bar-Shalom, Li, Kirubarajan 2001, 5.4; Bailey et al. 2006.)
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxslam.consistency._measures import REGISTRY, further
from jaxslam.consistency._measures.associations import association_scores, identities
from jaxslam.consistency._measures.counts import counts_of
from jaxslam.consistency._measures.measure import Measure, Nees, Runs, RunStatistics
from jaxslam.consistency._measures.nees import block_nees, pose_error
from jaxslam.core.protocols import Sensor
from jaxslam.core.types import Estimate, Info, Status, Trace, Truth
from jaxslam.math import _linalg as linalg
from jaxslam.math._pose_covariances import covariance_faults

LAGS = 10
"""Largest lag of the autocorrelation of innovations, in steps."""

_UNROLLED = 4
"""Measurement slots that are looked at in one piece of compiled code."""

_SNAPSHOTS = 25
"""Steps of each run at which error and covariance are kept as they are."""


class Score(NamedTuple):
    """The scores of a filter in R runs; the scores of a run that is not finite mean nothing."""

    finite: Bool[np.ndarray, "R"]
    """True if all numbers of the run are finite"""
    measures: dict[str, tuple[np.ndarray, np.ndarray]]
    """averages of each run, and their weights; no average where the weight is 0"""
    snapshots: tuple[np.ndarray, np.ndarray, np.ndarray]
    """pose error (R, K, 3), its covariance (R, K, 3, 3), mask of the regular ones (R, K)"""
    sums: dict[str, np.ndarray]
    """sums over runs: counts (R,), and (R, …) of measures."""


def snapshot_steps(steps: int) -> np.ndarray:
    """The steps (K,) of the snapshots, the last among them."""
    return np.unique(np.round(np.linspace(0, steps - 1, _SNAPSHOTS)).astype(int))


def score(
    trace: Trace,
    truth: Truth,
    statistics: RunStatistics,
    chart_error: Float[np.ndarray, "R T 3"] | None = None,
    measured: Int[np.ndarray, "R"] | None = None,
) -> Score:
    """The scores of R runs, by NumPy in float64; every array is the host's and has leading R.

    Args:
        trace: of the estimate only poses and their covariances are looked at, of the final state
            its observability monitor (`monitor_of`), and where it has one, of `probe` the
            information of that after each step (R, T, 3, 3).
        statistics: `run_statistics` of each run.
        chart_error: the pose errors in the coordinates of the filter (`chart_error_of`), by default
            the errors in (x, y, θ).
        measured: (R,) number of measurements in the log, by default counted in the infos.
    """
    pose, cov = map(np.asarray, trace.estimate[:2])
    error = pose_error(np.asarray(truth.pose), pose)
    steps = error.shape[1]
    nees = block_nees(pose, error, error if chart_error is None else chart_error, cov)
    landmarks = statistics.landmark_nees, statistics.regular_landmarks
    nees["landmarks"] = Nees(*(np.asarray(x, np.float64) for x in landmarks))
    faults = covariance_faults(pose, cov)
    is_faulty = faults.asymmetric | faults.indefinite
    is_still = [
        (rows == rows[:, :1]).reshape(len(rows), -1).all(axis=1)
        for rows in map(np.asarray, (trace.estimate.pose, trace.estimate.pose_cov, truth.pose))
    ]
    if measured is None:
        measured = (np.asarray(trace.info.status) != Status.EMPTY).sum(axis=(1, 2))
    sums: dict[str, np.ndarray] = {
        "steps": np.full(len(error), steps),
        "measured": np.asarray(measured),
        **counts_of(trace.info),
        "missed": np.asarray(truth.missed).sum(axis=1),
        "singular_steps": steps - nees["pose"].regular.sum(axis=1),
        "asymmetric_steps": faults.asymmetric.sum(axis=1),
        "indefinite_steps": faults.indefinite.sum(axis=1),
        "faulty_ends": is_faulty[:, -1],
        "singular_ends": ~nees["pose"].regular[:, -1] & ~is_faulty[:, -1],
        # Pose and covariance stay as they are, to the bit, while the robot moves.
        "constant": is_still[0] & is_still[1] & ~is_still[2],
    }
    runs = Runs(truth, trace, statistics, error, nees)
    measures: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    finite = np.array(statistics.finite)
    of_state = filter(None, map(further.measure_of, statistics.values))
    for measure in (*REGISTRY.values(), *of_state):
        scores = measure.of_runs(runs)
        if scores is None:
            continue
        total, weight = np.asarray(scores.total), np.broadcast_to(scores.weight, finite.shape)
        measures[measure.column] = total, weight
        sums |= scores.sums
    for rows in jax.tree.leaves((measures, sums)):
        finite &= np.isfinite(rows).reshape(len(rows), -1).all(axis=1)
    at = snapshot_steps(steps)
    return Score(
        finite=finite,
        measures=measures,
        snapshots=(error[:, at], cov[:, at], nees["pose"].regular[:, at]),
        sums=sums,
    )


class _White(NamedTuple):
    """Whitened innovations w, by landmark, or by measurement slot without a map; (N,) each."""

    w: list[Array]
    """its numbers; 0 where there is none"""
    square: Array
    """|w|²"""
    valid: Array
    """1 where there is one, else 0"""


class _Pairs(NamedTuple):
    """Sums over the pairs of a landmark's whitened innovations w and, steps later, w'; (LAGS, N)
    each. v is 1 where there is one, else 0."""

    product: Array
    """Σ wᵀw'"""
    earlier: Array
    """Σ |w|² v'"""
    later: Array
    """Σ v |w'|²"""
    number: Array
    """Σ v v'"""

    @classmethod
    def of(cls, before: _White, now: _White) -> "_Pairs":
        """The products of a step with those before it. before: (LAGS, N), now: (N,)."""
        product = jnp.zeros_like(before.square)
        if now.w:
            product = linalg.total(
                w * w_now[None] for w, w_now in zip(before.w, now.w, strict=True)
            )
        return cls(
            product=product,
            earlier=before.square * now.valid[None],
            later=before.valid * now.square[None],
            number=before.valid * now.valid[None],
        )

    def autocorrelation(self, size: int) -> Float[Array, "LAGS 3"]:
        """Σ wᵀw', √(Σ|w|² Σ|w'|²), over which that is the correlation, and the pairs of numbers, by
        lag. size: of w."""
        product, earlier, later, number = (values.sum(axis=1) for values in self)
        squares = earlier * later
        is_pair = squares > 0
        length = jnp.where(is_pair, jnp.sqrt(jnp.where(is_pair, squares, 1.0)), 0.0)
        return jnp.stack([product, length, number * size], axis=1)


class _Sums(NamedTuple):
    poison: Array
    """() 0 times every earlier number: NaN once one was not finite"""
    recent: _White
    """(LAGS, N) each, the latest steps first"""
    pairs: _Pairs


def run_statistics(
    trace: Trace, truth: Truth, sensor: Sensor, measures: Sequence[Measure] = ()
) -> RunStatistics:
    """The sums over one run that `score` is made of. For `vmap`, over runs.

    measures: those with `of_run` are taken, too. Raises ValueError on one that returns neither a
    number nor one a step.
    """
    estimate, info = trace.estimate, trace.info
    dtype, steps = estimate.pose.dtype, len(estimate.pose)
    points = jax.vmap(sensor.position)(jnp.asarray(truth.landmarks))

    # The true landmark of each one in the map, -1 of none; and the values of measures.
    held = jnp.where(estimate.alive, estimate.tag, -1)
    values: dict[str, Array | tuple[Array, Array]] = {}
    if truth.origin is not None:
        origin = jnp.asarray(truth.origin)
        held = identities(trace, origin)
        values |= association_scores(trace, origin, held)
    for measure in measures:
        if measure.of_run is None:
            continue
        value = jnp.asarray(measure.of_run(truth, trace), dtype)
        if value.shape not in ((), (steps,)):
            raise ValueError(
                f"measure {measure.key}: expected of_run to return a number or one for each of the "
                f"{steps} steps, got an array of shape {value.shape}"
            )
        values[measure.key] = value

    # One scan for the rest, which looks at one map at a time, not at T.
    def step(sums: _Sums, row: tuple[Estimate, Info, Array]) -> tuple[_Sums, PyTree]:
        estimate, info, held = row
        error = points[jnp.maximum(held, 0)] - estimate.points
        nees, regular = _planar_nees(error, jnp.asarray(estimate.point_covs))
        counts = regular & (held >= 0)
        before, now = sums.recent, _whitened(estimate, info)
        sums = _Sums(
            # 0 · x is NaN where x is not finite, and stays so in the sum.
            poison=sums.poison + 0 * _numbers((estimate, info)),
            recent=jax.tree.map(
                lambda old, new: jnp.concatenate([new[None], old[:-1]]), before, now
            ),
            pairs=jax.tree.map(jnp.add, sums.pairs, _Pairs.of(before, now)),
        )
        return sums, (jnp.where(counts, nees, 0.0).sum(), counts.sum().astype(dtype))

    size, count = info.innovation.shape[2], estimate.alive.shape[1] or info.slot.shape[1]
    zeros = jnp.zeros((LAGS, count), dtype)
    nothing = _Sums(
        poison=jnp.zeros_like(_numbers(jax.tree.map(lambda leaf: leaf[0], (estimate, info)))),
        recent=_White([zeros] * size, zeros, zeros),
        pairs=_Pairs(zeros, zeros, zeros, zeros),
    )
    sums, (nees, regular) = jax.lax.scan(step, nothing, (estimate, info, held))

    # The map at the end; a known one has no errors.
    is_judged = (held[-1] >= 0) & (estimate.point_covs[-1] != 0).any()
    error = points[jnp.maximum(held[-1], 0)] - estimate.points[-1]
    square = jnp.where(is_judged, (error**2).sum(axis=-1), 0.0).sum()
    return RunStatistics(
        finite=jnp.isfinite(sums.poison).all(),
        landmark_nees=nees,
        regular_landmarks=regular,
        landmark_squares=jnp.stack([square, is_judged.sum().astype(dtype)]),
        autocorrelation=sums.pairs.autocorrelation(size),
        values=values,
    )


def _numbers(tree: PyTree) -> Float[Array, "K"]:
    """Every floating-point number of a tree, in one row."""
    leaves = map(jnp.asarray, jax.tree.leaves(tree))
    return jnp.concatenate(
        [leaf.ravel() for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)]
    )


def _planar_nees(
    error: Float[Array, "N 2"], cov: Float[Array, "N 2 2"]
) -> tuple[Float[Array, "N"], Bool[Array, "N"]]:
    """The NEES eᵀ P⁻¹ e of each landmark, and whether P is regular: 1 - ρ² > 200 eps.

    a²/p₁ + (b - a p₁₂/p₁)²/(p₂(1 - ρ²)); 0 where P is not regular or e not finite.
    """
    p1, p12, p2 = cov[:, 0, 0], cov[:, 1, 0], cov[:, 1, 1]
    valid = (p1 > 0) & (p2 > 0) & jnp.isfinite(error).all(axis=1)
    p1, p2 = (jnp.where(valid, p, 1.0) for p in (p1, p2))
    left = 1 - (p12 / p1) * (p12 / p2)  # 1 - ρ², without products that underflow
    # 100 n·eps with n = 2, as in `block_nees`.
    regular = valid & (left > 200 * float(jnp.finfo(cov.dtype).eps))
    a = error[:, 0]
    b = error[:, 1] - a * (p12 / p1)
    nees = a**2 / p1 + b**2 / (p2 * jnp.where(regular, left, 1.0))
    return jnp.where(regular, nees, 0.0), regular


def _whitened(estimate: Estimate, info: Info) -> _White:
    """L⁻¹ν, with S = L Lᵀ, of the measurements that are fused.

    By landmark, of the first measurement fused with it; by measurement slot without a map.
    """
    fused = info.status == Status.FUSED

    def whiten(nu: Array, cov: Array) -> Array:
        return linalg.solve_lower(linalg.cholesky(cov)[0], nu)

    w = jax.vmap(whiten)(info.innovation, info.innovation_cov)
    w = jnp.where(fused[:, None], w, 0.0)
    by_measurement = _White([*w.T], (w**2).sum(axis=1), fused.astype(w.dtype))
    count = estimate.alive.shape[0]
    if count == 0:
        return by_measurement
    slot = jnp.where(fused, info.slot, -1)

    def place(kept: _White, measurement: tuple[_White, Array]) -> tuple[_White, None]:
        white, slot = measurement
        is_slot = jnp.arange(count, dtype=slot.dtype) == slot
        return jax.tree.map(lambda new, old: jnp.where(is_slot, new, old), white, kept), None

    nothing = jax.tree.map(lambda _: jnp.zeros(count, w.dtype), by_measurement)
    # In reverse, so that the first measurement of a landmark is written last, and stays.
    unroll = max(min(len(slot), _UNROLLED), 1)
    scan = jax.lax.scan(place, nothing, (by_measurement, slot), reverse=True, unroll=unroll)
    by_landmark: _White = scan[0]
    return by_landmark
