"""Estimates from elsewhere: their form, what is wrong with them, and their scores.

An estimate of a run becomes a `Trace` with a row at each step, whose landmark slots are the tags of
the world. So `run_statistics` and `score` take it as they take the trace of a filter. What was not
handed over is empty: it has no number in any run, hence no row in a table.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, PyTree

from jaxslam.consistency._measures.further import measures_of_state
from jaxslam.consistency._measures.measure import Measure, RunStatistics
from jaxslam.consistency._run_scores import LAGS, Score, score
from jaxslam.consistency.campaign._block import select_steps
from jaxslam.consistency.campaign._block_programs import statistics_program
from jaxslam.core._units import TURN
from jaxslam.core.protocols import Sensor
from jaxslam.core.types import Estimate, Info, Log, Status, Trace, Truth
from jaxslam.core.validation import InvalidField

MISSING, EARLY, GAPS = "missing", "ends early", "has no estimate at some steps"
NOT_FINITE = "not finite"
NO_COVARIANCE = "has no covariance beside the pose"
DEGREES = "heading in degrees"
TIMES = "has times that are not in the truth"
"""Reasons for which a run is not judged."""


class Innovations(NamedTuple):
    """The J innovations of one run: of each measurement of a landmark in the map, in any order."""

    rows: Int[np.ndarray, "J"]
    """the step of each, counted from 0"""
    tags: Int[np.ndarray, "J"]
    """the tag of its landmark, -1 if unknown: whiteness compares innovations of one landmark"""
    innovation: Float[np.ndarray, "J Z"]
    """ν = z - ẑ"""
    innovation_cov: Float[np.ndarray, "J Z Z"]
    """S"""
    rejected: Any = None
    """(J,) where a gate dropped the measurement; default nowhere. Leave these in: without them a
    gated NIS is below 1"""
    nis: Any = None
    """(J,) default νᵀS⁻¹ν; where a scan is fused as a whole, of each measurement given those before
    it, so that their sum is the NIS of the scan"""
    log_likelihood: Any = None
    """(J,) what each adds to the log-likelihood of the run; default log N(ν; 0, S), and with `nis`
    none"""


class RunEstimate(NamedTuple):
    """An estimate of one run of T steps by a program of your own: NumPy arrays, in map coordinates.

    It has a row at each of the K = T steps, or at each k-th (`stride`). Leave out what your
    estimator does not have: what is made of it has no row in the table.
    """

    poses: Float[np.ndarray, "K 3"]
    """x [m], y [m], θ [rad], after the measurements of the step"""
    covs: Float[np.ndarray, "K 3 3"]
    """claimed covariances of (x, y, θ)"""
    maps: Any = None
    """(means, covs, tags) of shapes (N, 2), (N, 2, 2), (N,) for the final map, for its RMSE and its
    NEES at the last step; with leading K for the map at each row, for the NEES at all of them. The
    tag of a landmark is its row in the map of the world, -1 for a place without a landmark."""
    innovations: Any = None
    """`Innovations`, or a tuple of their first fields, for NIS, whiteness and log-likelihood"""
    further: Any = None
    """(K, E) what the robot has beside its pose, `Motion.state[3:]` of the world, for its NEES"""
    further_covs: Any = None
    """(K, E, E), beside `further`"""


class RunFault(NamedTuple):
    """The reason for which a run is not judged."""

    reason: str
    """as "missing"; runs are counted by it"""
    detail: str = ""
    """of this run"""
    text: str = ""
    """a traceback, or what a program wrote to its standard error; "" without one"""


def as_estimate(value: object) -> RunEstimate:
    """A tuple (poses, covs), or an object with these and perhaps maps and innovations, as arrays.

    Raises InvalidField on anything else.
    """
    further = further_covs = None
    if hasattr(value, "poses") and hasattr(value, "covs"):
        fields = value.poses, value.covs, getattr(value, "maps", None)
        innovations = getattr(value, "innovations", None)
        further, further_covs = (getattr(value, f, None) for f in ("further", "further_covs"))
    elif isinstance(value, tuple) and len(value) == 2:
        fields, innovations = (*value, None), None
    else:
        raise InvalidField(
            "",
            "expected (poses, covs), or an object that has these and perhaps maps and innovations, "
            f"got {type(value).__name__}",
        )
    maps = fields[2]
    poses = _array("poses", fields[0], ("K", 3))
    covs = _array("covs", fields[1], (len(poses), 3, 3))
    if maps is not None:
        means, map_covs, tags = _parts("maps", maps, ("means", "covs", "tags"))
        lead = (len(poses),) if np.ndim(tags) == 2 else ()
        tags = _array("tags of maps", tags, (*lead, "N"))
        count = tags.shape[-1]
        means = _array("means of maps", means, (*lead, count, 2))
        maps = means, _array("covs of maps", map_covs, (*lead, count, 2, 2)), _whole(tags)
    if innovations is not None:
        fields_of = Innovations._fields
        count = len(innovations) if isinstance(innovations, tuple | list) else 0
        parts = _parts("innovations", innovations, fields_of[: min(max(count, 4), 7)])
        rows = _array("rows of innovations", parts[0], ("J",))
        nu = _array("ν of innovations", parts[2], (len(rows), "Z"))
        rejected, nis, log_likelihood = (
            None if value is None else _array(f"{field} of innovations", value, (len(rows),))
            for field, value in zip(
                fields_of[4:], (*parts[4:], *[None] * (7 - len(parts))), strict=True
            )
        )
        innovations = Innovations(
            _whole(rows),
            _whole(_array("tags of innovations", parts[1], (len(rows),))),
            nu,
            _array("S of innovations", parts[3], (len(rows), *[nu.shape[1]] * 2)),
            np.zeros(len(rows), bool) if rejected is None else rejected > 0,
            nis,
            log_likelihood,
        )
    if (further is None) != (further_covs is None):
        raise InvalidField("further", "expected both or none of further and further_covs")
    if further is not None:
        further = _array("further", further, (len(poses), "E"))
        further_covs = _array("further_covs", further_covs, (len(poses), *[further.shape[1]] * 2))
    return RunEstimate(poses, covs, maps, innovations, further, further_covs)


def _array(field: str, value: object, shape: tuple[int | str, ...]) -> np.ndarray:
    """An array of this shape, in which a letter is any number, in float64."""
    try:
        array = np.asarray(value)
        if array.dtype.kind == "c":  # NumPy would drop the imaginary part, with a warning
            raise TypeError
        array = array.astype(np.float64)
    except (TypeError, ValueError):
        raise InvalidField(field, f"expected real numbers, got {value!r:.60}") from None
    if array.ndim != len(shape) or any(
        isinstance(n, int) and n != m for n, m in zip(shape, array.shape, strict=True)
    ):
        expected = ", ".join(map(str, shape)) + "," * (len(shape) == 1)
        raise InvalidField(field, f"expected shape ({expected}), got {array.shape}")
    return array


def _parts(field: str, value: Any, parts: tuple[str, ...]) -> tuple[Any, ...]:
    if not isinstance(value, tuple | list) or len(value) != len(parts):
        raise InvalidField(field, f"expected ({', '.join(parts)}), got {type(value).__name__}")
    return tuple(value)


def _whole(values: np.ndarray) -> np.ndarray:
    """Rows or tags as integers; what is none becomes -2, which is refused as a number."""
    with np.errstate(invalid="ignore"):
        return np.where(values == np.round(values), values, -2).astype(int)


class RunShape(NamedTuple):
    """The sizes of a run's log."""

    steps: int
    places: int
    """M, the largest number of measurements of a step"""
    size: int
    """Z, the numbers of a measurement"""
    landmarks: int
    stride: int
    """k: steps k, 2k, …, T are judged"""
    further: int
    """E, the numbers of the robot beside its pose"""


def shape_of(log: Log, truth: Truth, stride: int) -> RunShape:
    """The sizes of a run, from its log and truth."""
    steps, places, size = np.shape(log.scan.z)
    further = 0 if truth.further is None else np.shape(truth.further)[1]
    return RunShape(steps, places, size, len(truth.landmarks), stride, further)


def select_rows(
    estimate: RunEstimate, truth: Truth, shape: RunShape
) -> tuple[RunEstimate, RunFault | None]:
    """An estimate with the rows that are judged alone, and what is wrong with the run, if anything.

    Raises InvalidField on more rows than steps, on a step or a tag that the run does not have, and
    on a landmark twice in a map.
    """
    steps, stride = shape.steps, shape.stride
    rows, expected = len(estimate.poses), steps // stride
    if rows == steps and stride > 1:
        at = slice(stride - 1, None, stride)
        maps = estimate.maps
        if maps is not None and maps[2].ndim == 2:
            maps = tuple(part[at] for part in maps)
        estimate = estimate._replace(poses=estimate.poses[at], covs=estimate.covs[at], maps=maps)
        if estimate.further is not None:
            beside = estimate.further[at], estimate.further_covs[at]
            estimate = estimate._replace(further=beside[0], further_covs=beside[1])
    elif rows > expected:
        counts = f"{steps}" if stride == 1 else f"{steps} or {expected}"
        raise InvalidField("poses", f"expected {counts} rows, got {rows}")
    if rows < expected:
        return estimate, RunFault(EARLY, f"{rows} of {expected} rows")
    _check_identities(estimate, shape)
    if estimate.further is not None and estimate.further.shape[1] != shape.further:
        reason = f"expected {shape.further} numbers a row, as the robot has beside its pose, got "
        raise InvalidField("further", f"{reason}{estimate.further.shape[1]}")
    for part, values in (
        ("poses", estimate.poses),
        ("covs", estimate.covs),
        ("further", () if estimate.further is None else estimate.further),
        ("further_covs", () if estimate.further_covs is None else estimate.further_covs),
        ("maps", estimate.maps or ()),
        ("innovations", estimate.innovations or ()),
    ):
        arrays = values if isinstance(values, tuple) else (values,)
        for array in arrays:
            if array is not None and not np.isfinite(array).all():
                row = int(np.argwhere(~np.isfinite(array))[0][0]) if array.ndim else 0
                return estimate, RunFault(NOT_FINITE, f"{part}, first at row {row}")
    if estimate.further_covs is not None:
        improper = ~_are_semidefinite(estimate.further_covs)
        if improper.any():
            return estimate, RunFault(NO_COVARIANCE, f"first at row {int(np.argmax(improper))}")
    true_heading = np.asarray(truth.pose, np.float64)[stride - 1 :: stride, 2]
    if _is_in_degrees(estimate.poses[:, 2], true_heading):
        largest = float(np.abs(estimate.poses[:, 2]).max())
        return estimate, RunFault(DEGREES, f"up to {largest:.4g}, and as degrees it fits the truth")
    return estimate, None


def _is_in_degrees(heading: np.ndarray, true_heading: np.ndarray) -> bool:
    """Whether headings fit the truth as degrees, and not as radians.

    A heading may be unwrapped: it is beyond ±2π, and fits as radians. As radians, degrees are as
    good as random, with a root mean square of π/√3 = 1.8; half a radian is no error to be judged.
    """
    if np.abs(heading).max() <= TURN:
        return False

    def misfit(angle: np.ndarray) -> float:
        error = (angle - true_heading + np.pi) % TURN - np.pi
        return float(np.sqrt(np.mean(error**2)))

    in_radians = misfit(heading)
    return in_radians > 0.5 and misfit(np.deg2rad(heading)) < in_radians / 4


def _check_identities(estimate: RunEstimate, shape: RunShape) -> None:
    """Raise InvalidField on a tag or a step that the run does not have."""
    if estimate.maps is not None:
        tags = np.atleast_2d(estimate.maps[2])
        _check_range("maps: tags", tags, -1, shape.landmarks)
        for row in tags:
            present = row[row >= 0]
            if len(np.unique(present)) < len(present):
                twice = next(int(tag) for tag in present if (present == tag).sum() > 1)
                raise InvalidField("maps", f"expected each tag once, got {twice} twice")
    if estimate.innovations is not None:
        rows, tags, nu, *_ = estimate.innovations
        _check_range("innovations: rows", rows, 0, shape.steps)
        _check_range("innovations: tags", tags, -1, shape.landmarks)
        if len(rows) and nu.shape[1] != shape.size:
            raise InvalidField(
                "innovations",
                f"expected ν of {shape.size} numbers, as a measurement has, got {nu.shape[1]}",
            )
        most = int(np.bincount(rows).max(initial=0))
        if most > shape.places:
            raise InvalidField(
                "innovations",
                f"expected at most {shape.places} at a step, as many as its measurements, got "
                f"{most} at step {int(np.bincount(rows).argmax())}",
            )


def _check_range(field: str, values: np.ndarray, least: int, end: int) -> None:
    outside = values[(values < least) | (values >= end)]
    if outside.size:
        reason = f"expected whole numbers from {least} to {end - 1}, got {int(outside[0])}"
        raise InvalidField(field, reason)


def trace_of(estimate: RunEstimate | None, shape: RunShape) -> tuple[Estimate, Info]:
    """The estimate, and the info, of one run at each of its T steps; zero where there is none."""
    steps, places, size, landmarks, stride, beside = shape
    further, further_cov = np.zeros((steps, beside)), np.zeros((steps, beside, beside))
    pose, cov = np.zeros((steps, 3)), np.zeros((steps, 3, 3))
    points, point_covs = np.zeros((steps, landmarks, 2)), np.zeros((steps, landmarks, 2, 2))
    alive = np.zeros((steps, landmarks), bool)
    nis, log_likelihood = np.zeros((steps, places)), np.zeros(steps)
    status, slot = np.zeros((steps, places), int), np.full((steps, places), -1)
    nu, S = np.zeros((steps, places, size)), np.zeros((steps, places, size, size))
    if estimate is not None:
        judged = np.arange(stride - 1, steps, stride)
        pose[judged], cov[judged] = estimate.poses, estimate.covs
        if estimate.further is not None:
            further[judged], further_cov[judged] = estimate.further, estimate.further_covs
        if estimate.maps is not None:
            means, map_covs, tags = estimate.maps
            is_final = tags.ndim == 1
            for i, step in enumerate(judged[-1:] if is_final else judged):
                row = tags if is_final else tags[i]
                at = row[row >= 0]
                points[step, at] = (means if is_final else means[i])[row >= 0]
                point_covs[step, at] = (map_covs if is_final else map_covs[i])[row >= 0]
                alive[step, at] = True
        if estimate.innovations is not None and len(estimate.innovations.rows):
            order = np.argsort(estimate.innovations.rows, kind="stable")
            ordered: PyTree = [p if p is None else p[order] for p in estimate.innovations]
            rows, tags, innovations, covs, rejected, own_nis, terms = ordered
            # The place of an innovation is its number among those of its step.
            place = np.arange(len(rows)) - np.searchsorted(rows, rows)
            regular = _are_definite(covs)
            became = np.where(rejected, Status.REJECTED, Status.FUSED)
            status[rows, place] = np.where(regular, became, Status.SINGULAR)
            slot[rows, place] = tags
            nu[rows, place] = innovations
            S[rows, place] = np.where(regular[:, None, None], covs, np.eye(size))
            L = np.linalg.cholesky(S[rows, place])
            white = np.linalg.solve(L, innovations[..., None])[..., 0]
            squares = (white**2).sum(axis=1) if own_nis is None else own_nis
            nis[rows, place] = np.where(regular, squares, 0.0)
            if terms is None:
                spread = 2 * np.log(np.diagonal(L, axis1=1, axis2=2)).sum(axis=1)
                terms = -0.5 * (squares + spread + size * np.log(2 * np.pi))
                terms = np.where(regular & ~rejected, terms, 0.0)
            np.add.at(log_likelihood, rows, terms)
    fused = status == Status.FUSED
    tag = np.where(alive, np.arange(landmarks), -1)
    # In the order of `Info`, whose fields are declared as JAX arrays.
    numbers: PyTree = nis, np.where(fused, size, 0), nu, S, slot, status, log_likelihood
    of_robot: PyTree = (further, further_cov) if beside else (None, None)
    return Estimate(pose, cov, points, point_covs, alive, tag, *of_robot), Info(*numbers)


def _are_definite(covs: Float[np.ndarray, "J Z Z"]) -> np.ndarray:
    """Whether innovation covariances are symmetric, to a millionth, and positive definite."""
    least, is_symmetric = _least_eigenvalues(covs)
    # 100 n eps, as in `block_nees`.
    return np.asarray(is_symmetric & (least > 100 * covs.shape[1] * np.finfo(float).eps))


def _are_semidefinite(covs: Float[np.ndarray, "K E E"]) -> np.ndarray:
    """Whether covariances are symmetric and have no negative eigenvalue, to a millionth."""
    least, is_symmetric = _least_eigenvalues(covs)
    return np.asarray(is_symmetric & (least >= -1e-6))


def _least_eigenvalues(covs: Float[np.ndarray, "J Z Z"]) -> tuple[np.ndarray, np.ndarray]:
    """The least eigenvalue of matrices scaled to a unit diagonal, and whether they are symmetric,
    to a millionth."""
    size = np.abs(np.diagonal(covs, axis1=1, axis2=2))
    root = np.sqrt(np.where(size > 0, size, 1.0))
    scaled = covs / root[:, :, None] / root[:, None, :]
    is_symmetric = np.abs(scaled - np.swapaxes(scaled, 1, 2)).max(axis=(1, 2)) <= 1e-6
    least = np.linalg.eigvalsh((scaled + np.swapaxes(scaled, 1, 2)) / 2)[:, 0]
    return least, is_symmetric


def score_estimates(
    estimates: Sequence[RunEstimate | None],
    truth: Truth,
    shape: RunShape,
    state: tuple[str, ...],
    sensor: Sensor,
    device: jax.Device,
    block: int,
) -> Score:
    """The scores of the estimates of R runs; a run without one is not finite.

    truth: (R, …), float64. state: of the robot. block: R or more, for which statistics are compiled
    once.
    """
    runs, stride = len(estimates), shape.stride
    # What a measurement is truly of is the identity of a slot by the info of our filters: maps of
    # such worlds have no landmark of a tag.
    truth, scores_maps = truth._replace(origin=None), truth.origin is None
    if not scores_maps:
        estimates = [e if e is None else e._replace(maps=None) for e in estimates]
    traces = [trace_of(estimate, shape) for estimate in estimates]
    estimate, info = jax.tree.map(lambda *leaves: np.stack(leaves), *traces)
    has_innovations = bool((info.status != Status.EMPTY).any())
    has_further = any(e is not None and e.further is not None for e in estimates)
    if not has_further:
        estimate = estimate._replace(further=None, further_cov=None)
    if has_innovations or estimate.alive.any() or has_further:
        of_state = measures_of_state(state) if has_further else ()
        statistics = _statistics(estimate, info, truth, of_state, sensor, device, block)
    else:
        by_step = np.zeros((runs, shape.steps))
        # In the order of `RunStatistics`, whose fields are declared as JAX arrays.
        on_runs: PyTree = np.ones(runs, bool), by_step, by_step, np.zeros((runs, 2))
        statistics = RunStatistics._make((*on_runs, np.zeros((runs, LAGS, 3)), {}))
    absent: PyTree = None
    trace = Trace(
        Estimate(estimate.pose, estimate.pose_cov, *[absent] * 4),
        info._replace(innovation=absent, innovation_cov=absent, slot=absent),
        None,
        None,
    )
    measured = (info.status != Status.EMPTY).sum(axis=(1, 2))
    truth = truth._replace(missed=np.zeros((runs, shape.steps), int))
    with np.errstate(over="ignore", invalid="ignore"):  # of 1e200 m: the run is not finite then
        scores = score(*select_steps(stride, trace, truth, statistics, None, measured))
    # Neither the coordinates of its error nor the measurements that it did not use are known.
    measures = {name: value for name, value in scores.measures.items() if name != "nees_own"}
    sums = dict(scores.sums)
    if any(
        e is not None
        and e.innovations is not None
        and e.innovations.nis is not None
        and e.innovations.log_likelihood is None
        for e in estimates
    ):
        total, _ = measures["log_likelihood"]
        measures["log_likelihood"] = total, np.zeros(runs)
    del sums["measured"]
    has_estimate = np.array([estimate is not None for estimate in estimates])
    return scores._replace(finite=scores.finite & has_estimate, measures=measures, sums=sums)


def _statistics(
    estimate: Estimate,
    info: Info,
    truth: Truth,
    measures: tuple[Measure, ...],
    sensor: Sensor,
    device: jax.Device,
    block: int,
) -> RunStatistics:
    """`run_statistics` of each run, by the program of a campaign, padded to a block."""
    runs = len(estimate.pose)
    which = np.minimum(np.arange(block), runs - 1)
    program = statistics_program((device,), measures)

    def in_default_dtype(leaf: np.ndarray) -> np.ndarray:
        # As JAX is set: float32 without 64-bit types.
        return np.asarray(leaf[which], jnp.result_type(float if leaf.dtype.kind == "f" else leaf))

    by_run, *by_time = jax.tree.map(in_default_dtype, (truth, estimate, info))
    by_time = jax.tree.map(lambda leaf: np.swapaxes(leaf, 0, 1), by_time)
    padded = jax.device_get(program(sensor, by_run, *by_time))
    statistics: RunStatistics = jax.tree.map(lambda leaf: leaf[:runs], padded)
    return statistics


def estimate_of_run(estimate: RunEstimate, shape: RunShape) -> Estimate:
    """The estimate of one run at the steps that are judged, for figures."""
    of_steps, _ = trace_of(estimate, shape)
    judged = slice(shape.stride - 1, None, shape.stride)
    rows: Estimate = jax.tree.map(lambda leaf: leaf[judged], of_steps)
    return rows
