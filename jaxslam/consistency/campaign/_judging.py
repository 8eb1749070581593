"""Estimators from elsewhere, judged on the draws of a campaign, beside filters of the library."""

import contextlib
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import jax
import numpy as np

from jaxslam._origin import to_map_coordinates
from jaxslam.consistency._run_scores import Score
from jaxslam.consistency._summary import Summary
from jaxslam.consistency._tally import Tally, condense
from jaxslam.consistency.campaign._block import BOUND, BlockRunner, CampaignPlan, rows_of_truth
from jaxslam.consistency.campaign._block_programs import fitting_block
from jaxslam.consistency.campaign._candidates import candidate_for, check_noise
from jaxslam.consistency.campaign._harness import move_to_start, sum_up
from jaxslam.consistency.campaign._kept import flatten
from jaxslam.consistency.campaign._pieces import missing_pieces
from jaxslam.consistency.campaign._progress import Progress
from jaxslam.consistency.campaign._result import Campaign
from jaxslam.consistency.campaign._run_estimates import (
    NOT_FINITE,
    RunEstimate,
    RunFault,
    RunShape,
    as_estimate,
    estimate_of_run,
    score_estimates,
    select_rows,
    shape_of,
)
from jaxslam.consistency.campaign._work import Work, progress_report
from jaxslam.core._numbers import is_concrete
from jaxslam.core._reprs import describe
from jaxslam.core.protocols import Candidate
from jaxslam.core.types import Estimate, Log, Truth
from jaxslam.core.validation import (
    InvalidField,
    at_least,
    instance_of,
    or_none,
    prng_key,
    refusals_of,
    require,
)
from jaxslam.simulation._worlds import World, run_count, with_positions

_LISTED = 3
"""Runs of which a doubt has the details."""

_FAULTS_OF_COV = {"asymmetric_steps": "not symmetric", "indefinite_steps": "not positive definite"}


class Outcome(NamedTuple):
    """The result of an estimator on one run."""

    truth: Truth
    """what its estimate is compared with"""
    estimate: RunEstimate | None
    fault: RunFault | None = None
    seconds: float | None = None
    """wall time; None where it is not known"""


Source = Callable[[int, Truth, Log], Outcome]
"""function of the number of a run, its truth and its log, on the host"""


def judge_estimator(
    world: World,
    function: Callable[[Log], Any],
    runs: int,
    key: jax.Array,
    *,
    filters: Mapping[str, Candidate] = MappingProxyType({}),
    name: str = "estimator",
    stride: int = 1,
    bound: bool = False,
    block: int | None = None,
    devices: Sequence[jax.Device] | None = None,
    progress: Callable[[int, int], None] | Literal[False] | None = None,
) -> Campaign:
    """Judge an estimator of your own, in plain Python, as `monte_carlo` judges filters.

        def my_filter(log):
            ...                                  # NumPy, or what you like
            return poses, covs                   # (T, 3) and (T, 3, 3)

        print(judge_estimator(world, my_filter, 50, jax.random.key(0), filters={"ekf": ekf}))

    The function is called once for each run, one after the other. Its log has NumPy arrays: control
    (T, U), and scan with z (T, M, Z), tag (T, M) and valid (T, M). It returns (poses, covs), or an
    object that has these and perhaps maps and innovations, as a `RunEstimate`. The draws are those
    of `monte_carlo` with the same world and key.

    A run is not judged if the function raises an exception, or returns too few rows, a number that
    is not finite, or headings in degrees. Such runs are counted as not finite, by reason in
    `Summary.faults`, and the first traceback is in `Campaign.notes`. A step whose covariance is not
    symmetric or not positive definite has no NEES, and is counted. In a world of `spurious` data
    maps are not judged: which landmark is meant is not known.

    Args:
        world: what to draw; see `scenarios`.
        function: the estimator. It need not be traceable, nor use JAX.
        runs: how many worlds; run i has key fold_in(key, i).
        key: a PRNG key.
        filters: of the library, on the same draws, by name; as in `monte_carlo`.
        name: of the estimator in tables and figures.
        stride: k: steps k, 2k, …, T are judged alone, also of `filters`; a divisor of the steps T.
            The function may return these rows alone.
        bound, block, devices, progress: as in `monte_carlo`.
    Returns:
        Campaign.
    Raises:
        ValueError: on arguments that `monte_carlo` does not take, a name that a filter has, a
            stride that does not divide the steps, and a result of another form or shape.
    """
    if not callable(function) or isinstance(function, type):
        reason = f"expected a function of the log, got {function!r:.60}"
        raise InvalidField("function", reason, owner="judge_estimator")

    def outcome_of(number: int, truth: Truth, log: Log) -> Outcome:
        began = time.perf_counter()
        try:
            value = function(log)
        except Exception as error:
            # Without the frame of this function.
            error = error.with_traceback(error.__traceback__ and error.__traceback__.tb_next)
            first_line = (str(error).strip().splitlines() or [""])[0]
            reason = f"raises {type(error).__name__}"
            text = "".join(traceback.format_exception(error)).rstrip()
            return Outcome(truth, None, RunFault(reason, first_line, text))
        seconds = time.perf_counter() - began
        with refusals_of(f"judge_estimator: {name}, run {number}"):
            estimate = as_estimate(value)
        return Outcome(truth, estimate, None, seconds)

    return judge_sources(
        world,
        {name: outcome_of},
        runs,
        key,
        filters=filters,
        stride=stride,
        bound=bound,
        block=block,
        devices=devices,
        progress=progress,
    )


def judge_sources(
    world: World,
    sources: Mapping[str, Source],
    runs: int,
    key: jax.Array,
    *,
    filters: Mapping[str, Candidate],
    stride: int = 1,
    bound: bool = False,
    block: int | None = None,
    devices: Sequence[jax.Device] | None = None,
    progress: Callable[[int, int], None] | Literal[False] | None = None,
    save: Callable[[dict[str, np.ndarray]], object] | None = None,
) -> Campaign:
    """The campaign of estimators from elsewhere, by name, and of filters; see `judge_estimator`.

    save: called with the arrays of all runs, as a store keeps them.
    """
    with jax.transfer_guard("allow"):
        with refusals_of("judge_estimator"):
            _check(world, sources, runs, key, filters, stride, block)
        began, runs = time.perf_counter(), int(runs)
        devices = jax.local_devices() if devices is None else list(devices)
        size = int(block or (fitting_block(world, filters, devices[0]) if filters else 16))
        near, near_filters, origin = move_to_start(world, filters)
        plan = CampaignPlan(near, near_filters, key, devices, size, bound, None, stride)
        pieces = missing_pieces([], runs, plan.wide)
        judged = _judge_pieces(plan, sources, pieces, origin, progress)
        # The filters, and with them the limit of accuracy, which needs the world alone.
        work = Work(2, None, {name: Tally() for name in (*filters, BOUND)})
        shown = progress if filters or progress is not None else False
        with progress_report(shown, plan) as report:
            work.compute(plan, pieces, report)
        limit = float(work.tallies[BOUND].first("limit"))
        tallies = {name: Tally() for name in sources} | work.tallies
        for name, estimator in judged.items():
            for (first, count), scores in zip(pieces, estimator.scores, strict=True):
                tallies[name].add(first, count, condense(scores, first, limit))
        campaign = sum_up(plan, tallies, work, origin, time.perf_counter() - began, compare=True)
        summaries = {
            name: judged[name].qualify(summary, pieces) if name in judged else summary
            for name, summary in campaign.filters.items()
        }
        notes = [note for estimator in judged.values() for note in estimator.notes()]
        if stride > 1:
            notes.insert(
                0, f"judged at {campaign.steps:,} of {world.steps:,} steps, one in {stride}."
            )
        campaign = replace(
            campaign,
            filters=summaries,
            first={n: e.first for n, e in judged.items() if e.first is not None} | campaign.first,
            run_seconds={n: float(np.median(e.seconds)) for n, e in judged.items() if e.seconds},
            notes=tuple(notes),
        )
        if save is not None:
            blocks = {name: tally.block() for name, tally in tallies.items()}
            save(flatten(blocks, tallies))
        return campaign


class _Judgement:
    """The scores of an estimator from elsewhere, and what is wrong with its runs."""

    def __init__(self, name: str, source: Source, plan: CampaignPlan) -> None:
        self.name, self.source, self.plan = name, source, plan
        self.scores: list[Score] = []
        self.faults: dict[int, RunFault] = {}
        self.seconds: list[float] = []
        self.first: tuple[Truth, Estimate] | None = None
        self.has_final_maps = False

    def judge_run(self, number: int, truth: Truth, log: Log, shape: RunShape) -> Outcome:
        """The outcome of a run: its estimate at the judged steps, or what is wrong with it."""
        copied = jax.tree.map(np.copy, log)  # the estimator may write into it
        outcome = self.source(number, truth, copied)
        if outcome.fault is None and outcome.estimate is not None:
            with refusals_of(f"{self.name}, run {number}"):
                estimate, fault = select_rows(outcome.estimate, outcome.truth, shape)
            outcome = outcome._replace(estimate=None if fault else estimate, fault=fault)
        if outcome.fault is not None:
            self.faults[number] = outcome.fault
        if outcome.seconds is not None:
            self.seconds.append(outcome.seconds)
        if outcome.estimate is not None and outcome.estimate.maps is not None:
            tags = outcome.estimate.maps[2]
            self.has_final_maps |= tags.ndim == 1 and bool((tags >= 0).any())
        if number == 0 and outcome.estimate is not None:
            stride = self.plan.stride
            run_0 = with_positions(self.plan.scenario.sensor, outcome.truth)
            run_0 = rows_of_truth(run_0, slice(stride - 1, None, stride))
            self.first = run_0, estimate_of_run(outcome.estimate, shape)
        return outcome

    def score_piece(self, outcomes: Sequence[Outcome], shape: RunShape) -> None:
        """Add the scores of successive runs."""
        truths = [outcome.truth for outcome in outcomes]
        scores = score_estimates(
            [outcome.estimate for outcome in outcomes],
            jax.tree.map(lambda *leaves: np.stack(leaves), *truths),
            shape,
            self.plan.scenario.motion.state,
            self.plan.scenario.sensor,
            self.plan.devices[0],
            self.plan.wide,
        )
        self.scores.append(scores)

    def qualify(self, summary: Summary, pieces: Sequence[tuple[int, int]]) -> Summary:
        """The summary with the reasons for which runs are not judged, and with the numbers of the
        runs whose covariances are none."""
        by_reason: dict[str, list[int]] = {}
        for number in summary.not_finite_runs:
            fault = self.faults.get(number, RunFault(NOT_FINITE))
            by_reason.setdefault(fault.reason, []).append(number)
        doubts = list(summary.doubts)
        if by_reason:
            # In place of the doubt on runs that are not finite, which is the first.
            doubts[0] = self._doubt(by_reason, summary.counts["runs"])
        for name, fault_of_cov in _FAULTS_OF_COV.items():
            numbers = [
                first + int(i)
                for (first, _), scores in zip(pieces, self.scores, strict=True)
                for i in np.flatnonzero(scores.finite & (scores.sums[name] > 0))
            ]
            if numbers:
                listed = ", ".join(map(str, numbers[:20])) + ", …" * (len(numbers) > 20)
                plural = "s" * (len(numbers) > 1)
                doubts.append(f"its covariance is {fault_of_cov} in run{plural} {listed}")
        faults = {reason: tuple(numbers) for reason, numbers in by_reason.items()}
        return replace(summary, doubts=tuple(doubts), faults=faults)

    def _doubt(self, by_reason: Mapping[str, Sequence[int]], rest: int) -> str:
        """The sentence on runs that are not judged."""
        parts = []
        for reason, numbers in by_reason.items():
            faults = [(n, self.faults[n].detail) for n in numbers if n in self.faults]
            details = [f"run {n}: {detail}" for n, detail in faults if detail]
            listed = "; ".join(details[:_LISTED]) + "; …" * (len(details) > _LISTED)
            parts.append(f"{len(numbers):,} {reason}" + f" ({listed})" * bool(listed))
        lost = sum(map(len, by_reason.values()))
        averages = f"averages of the {rest:,} judged runs" if rest else "there are no averages"
        verb = "is" if lost == 1 else "are"
        return f"{lost:,} of {lost + rest:,} runs {verb} not judged: {', '.join(parts)}: {averages}"

    def notes(self) -> list[str]:
        """The texts below the table."""
        notes = []
        for number, fault in self.faults.items():
            if fault.text:
                notes.append(f"{self.name}, run {number}, the first that failed:\n{fault.text}")
                break
        if self.has_final_maps:
            notes.append(
                f"{self.name}: the landmark NEES is of its final maps, without steps before."
            )
        return notes


def _judge_pieces(
    plan: CampaignPlan,
    sources: Mapping[str, Source],
    pieces: Sequence[tuple[int, int]],
    origin: np.ndarray | None,
    progress: Callable[[int, int], None] | Literal[False] | None,
) -> dict[str, _Judgement]:
    """The scores of each estimator in pieces (first, runs) of a campaign."""
    runner, world = BlockRunner(plan), plan.scenario
    judged = {name: _Judgement(name, source, plan) for name, source in sources.items()}
    runs = sum(count for _, count in pieces)
    title = f"{world.name}, {', '.join(sources)}"
    with Progress(title) if progress is None else contextlib.nullcontext(progress or None) as bar:
        for first, count in pieces:
            truths, logs = runner.draws(first, count)
            if np.ndim(truths.pose) != 3:
                raise InvalidField("world", "expected one robot", owner="judge_estimator")
            outcomes: dict[str, list[Outcome]] = {name: [] for name in sources}
            for i in range(count):
                truth, log = jax.tree.map(lambda leaf, i=i: leaf[i], (truths, logs))
                truth = truth if origin is None else to_map_coordinates(truth, origin)
                shape = shape_of(log, truth, plan.stride)
                for name, judgement in judged.items():
                    outcomes[name].append(judgement.judge_run(first + i, truth, log, shape))
                if bar is not None:
                    bar(first + i + 1, runs)
            for name, judgement in judged.items():
                judgement.score_piece(outcomes[name], shape)
    return judged


def _check(
    world: World,
    sources: Mapping[str, Source],
    runs: int,
    key: jax.Array,
    filters: Mapping[str, Candidate],
    stride: int,
    block: int | None,
) -> None:
    """Raise InvalidField on arguments that `judge_estimator` does not take."""
    require("world", world, instance_of(World))
    require("runs", runs, run_count(world))
    require("stride", stride, at_least(1))
    require("block", block, or_none(at_least(1)))
    if world.steps % stride:
        reason = f"expected a divisor of the {world.steps} steps, got {stride}"
        raise InvalidField("stride", reason)
    require("key", key, prng_key)
    if not is_concrete(key):
        raise InvalidField("", "it compiles its own programs: call it outside of jax.jit")
    if not isinstance(filters, Mapping):
        raise InvalidField("filters", f"expected {{name: filter}}, got {describe(filters)}")
    for name in (*sources, *filters):
        if not isinstance(name, str) or not name.strip() or not name.isprintable():
            raise InvalidField("name", f"expected a name, as 'mine', got {name!r}")
    for name, candidate in filters.items():
        if name in sources:
            raise InvalidField("name", f"{name!r} is the name of a filter")
        require(f"filter {name}", candidate, candidate_for(world))
    check_noise(world)
