"""Two estimators on the same draws, compared run by run.

The error of a run is due to its draws as much as to the estimator, and the draws are the same. So
the differences of the runs spread less than their numbers do, and a campaign says more about a
difference than the two intervals of its table.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxslam.consistency._intervals import LEVEL, Average, interval
from jaxslam.consistency._measures import REGISTRY
from jaxslam.consistency._measures.measure import Measure
from jaxslam.consistency._summary import Summary

_FEW = 20
"""Runs below which an interval depends on whether differences are normal. From here on a single run
with over half of the squared deviations is unusual: it happens in 0.6 % of campaigns whose
differences are normal, against 13 % with 10 runs (the beta law of one squared deviation of n)."""


class PairedDifference(NamedTuple):
    """A measure of two estimators over the same runs, and the difference first - second."""

    first: float
    """average of the first estimator"""
    second: float
    difference: Average
    """with its 95 % interval (`LEVEL`): Student's t over the differences of the runs"""
    share: float | None
    """share of the runs in which the first is better, ties counted half; None where a single run
    does not say (`Measure.better`)"""
    narrower: float
    """width of the interval of two campaigns of as many runs, each on draws of its own, over that
    of this one: √((s₁² + s₂²)/s_d²), with deviations s over the runs; NaN if all are 0"""
    runs: int
    """the runs in which both have a number"""
    largest: float
    """largest share of one run in the squared deviations of the differences from their mean; 0 if
    all are equal"""


def paired_difference(
    measure: Measure, first: Float[np.ndarray, "R"], second: Float[np.ndarray, "R"]
) -> PairedDifference | None:
    """The difference of a measure of two estimators; None of fewer than two runs of both.

    first, second: the measure in each run, as in `Summary.per_run`; NaN: no number.
    """
    both = np.isfinite(first) & np.isfinite(second)
    first, second = first[both], second[both]
    if len(first) < 2:
        return None
    values = [measure.pseudo_values(numbers) for numbers in (first, second)]
    differences = values[0] - values[1]
    average = interval(differences, LEVEL)
    assert average is not None
    share = None
    if measure.better != "honest":
        gain = second - first if measure.better == "smaller" else first - second
        share = float(np.mean((gain > 0) + 0.5 * (gain == 0)))
    squares = (differences - differences.mean()) ** 2
    independent = sum(float(np.sum((numbers - numbers.mean()) ** 2)) for numbers in values)
    paired = float(squares.sum())
    return PairedDifference(
        first=float(values[0].mean()),
        second=float(values[1].mean()),
        difference=average,
        share=share,
        narrower=(independent / paired) ** 0.5 if paired > 0 else np.inf if independent else np.nan,
        runs=len(first),
        largest=float(squares.max()) / paired if paired > 0 else 0.0,
    )


def compare_runs(
    names: tuple[str, str], first: Summary, second: Summary, runs: int
) -> tuple[int, dict[str, PairedDifference], tuple[str, ...]]:
    """The number of runs that both have finished, the differences of the measures that can be
    compared (`Measure.better`) by key, and sentences that qualify them.

    first, second: summaries of the same runs. runs: their number, lost ones counted.
    """
    lost = [len(summary.not_finite_runs) for summary in (first, second)]
    pairs = runs - len({*first.not_finite_runs, *second.not_finite_runs})
    differences: dict[str, PairedDifference] = {}
    by_count: dict[int, list[str]] = {}
    dominated: list[str] = []
    for measure in REGISTRY.values():
        columns = [summary.per_run.get(measure.column) for summary in (first, second)]
        if not measure.better or columns[0] is None or columns[1] is None:
            continue
        difference = paired_difference(measure, columns[0], columns[1])
        if difference is None:
            continue
        differences[measure.key] = difference
        if difference.runs < pairs:
            by_count.setdefault(difference.runs, []).append(measure.label)
        if difference.runs >= _FEW and difference.largest > 0.5:
            dominated.append(measure.label)
    doubts = []
    if any(lost):
        doubts.append(
            f"{runs - pairs:,} of {runs:,} runs are left out: {names[0]} has no numbers in "
            f"{lost[0]:,}, {names[1]} in {lost[1]:,}; the differences say nothing of them"
        )
    if pairs < 2:
        doubts.append("there are no differences, since under two runs are left")
    elif pairs < _FEW:
        doubts.append(
            f"{pairs} runs are few: an interval holds if the differences of runs are normal"
        )
    doubts += [
        f"{', '.join(labels)}: of the {count:,} runs in which both have a number"
        for count, labels in by_count.items()
    ]
    if dominated:
        doubts.append(
            f"{', '.join(dominated)}: a single run has over half of the squared deviations of the "
            "differences, so that the interval is that run's; look at the share of runs"
        )
    fused = [summary.counts.get("fused", 0) for summary in (first, second)]
    if "log_likelihood" in differences and fused[0] != fused[1]:
        doubts.append(
            f"log-likelihood: {names[0]} fused {fused[0]:,} measurements and {names[1]} "
            f"{fused[1]:,}; comparable only between filters that fused the same"
        )
    return pairs, differences, tuple(doubts)
