"""What a measure of consistency is: a number or a curve of each run, averaged over the runs.

A measure has a name, an honest value, a computation and the places where it is
shown. Its class is `Measure` where a function of JAX computes it, and a subclass in a file of this
package where it is made of what all measures share (`Runs`).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from jaxslam.consistency._intervals import Average, interval, positive_interval
from jaxslam.core.types import Trace, Truth

Better = Literal["", "smaller", "larger", "honest"]
"""Which of two estimators a measure prefers; see `Measure.better`."""

Sums = Mapping[str, np.ndarray]
"""Sums over all runs of a campaign, by name."""


class Nees(NamedTuple):
    """The NEES of one block of the pose error, at each step."""

    value: Float[np.ndarray, "..."]
    """0 without a value."""
    regular: Bool[np.ndarray, "..."]
    """mask of the values"""


class RunStatistics(NamedTuple):
    """The sums over the steps of one run; with a leading axis, of many."""

    finite: Bool[Array, ""]
    """True if all numbers of the estimates and infos are finite"""
    landmark_nees: Float[Array, "T"]
    """NEES summed over the landmarks of the map"""
    regular_landmarks: Float[Array, "T"]
    """number of landmarks that have a NEES"""
    landmark_squares: Float[Array, "2"]
    """Σ |p̂ - p|² [m²] over the final map, unaligned, and the number of landmarks in it; 0 for a
    known map, without covariances"""
    autocorrelation: Float[Array, "LAGS 3"]
    """Σ w_tᵀ w_{t+l}, √(Σ|w_t|² Σ|w_{t+l}|²), and the number of products of numbers in it, for
    whitened innovations w = L⁻¹ν, S = L Lᵀ, of one landmark at t and t + l; without a map, of one
    measurement slot"""
    values: dict[str, Array | tuple[Array, Array]]
    """results of `of_run` by key of the measure; in a world of spurious data, sum and weight of
    each of `associations`"""


class Runs(NamedTuple):
    """R runs of a filter, as measures see them: NumPy, leading axis R."""

    truth: Truth
    trace: Trace
    """poses and their covariances of the estimate, infos without innovations and slots; of a
    monitored filter the monitor, and as `probe` the information of each step"""
    statistics: RunStatistics
    error: Float[np.ndarray, "R T 3"]
    """truth - estimate of the pose, in float64"""
    nees: Mapping[str, Nees]
    """(R, T) of pose, position, heading, own (the filter's coordinates) and landmarks"""


class RunScores(NamedTuple):
    """A measure of each of R runs."""

    total: np.ndarray
    """(R,) the sum within each run, whose number is total / weight"""
    weight: np.ndarray | int
    """(R,) the number of terms of the sum; a run of weight 0 has no number"""
    sums: Sums = MappingProxyType({})
    """(R, …) summed over the runs, for `Measure.curves`, by name"""


@dataclass(frozen=True, eq=False)
class Measure:
    """A measure of consistency. One that a user adds has at least a key, a label and `of_run`."""

    key: str
    """its name in `Summary.measures`, in JSON and in CSV"""
    label: str
    """label of its row in tables; one that starts with a space belongs to the row above"""
    of_run: Callable[[Truth, Trace], Array] | None = None
    """function of one run, traced by JAX: a number, or a curve (T,) whose average over the steps is
    the number. What is not finite is absent. The trace has no final state and no probe."""
    honest: float | None = None
    """the average of a consistent filter, if it is known"""
    unit: str = ""
    positive: bool = False
    """True if it is never negative: the interval is `positive_interval`, else `interval`"""
    note: tuple[str, str] | None = None
    """a term and a sentence below the table, if the label is not enough"""
    row: bool = True
    """True if tables show it"""
    figure: str = ""
    """the figure that has a panel for its curve: "nees", "rmse" or "gained" """
    axis: str = ""
    """label of that panel; default label and unit"""
    column: str = ""
    """name of each run's number in `Summary.per_run`; default the key"""
    better: Better = ""
    """which of two estimators `Campaign.compare` calls better in a run: the one with the smaller
    or the larger number. "honest": their averages are compared with `honest`, and no run alone
    says which is better. "": not compared"""

    def __post_init__(self) -> None:
        if self.better not in get_args(Better):
            raise ValueError(
                f"measure {self.key}: better: expected one of {get_args(Better)}, got "
                f"{self.better!r}"
            )
        object.__setattr__(self, "column", self.column or self.key)
        object.__setattr__(self, "axis", self.axis or self.title)

    @property
    def title(self) -> str:
        """Label and unit of a row."""
        return f"{self.label} [{self.unit}]" if self.unit else self.label

    def of_runs(self, runs: Runs) -> RunScores | None:
        """The measure of each run; None where such a filter has none."""
        value = runs.statistics.values.get(self.key)
        if value is None:
            return None
        if isinstance(value, tuple):
            return RunScores(np.asarray(value[0]), np.asarray(value[1]))
        finite = np.isfinite(value)
        values = np.where(finite, value, 0.0).astype(np.float64)
        if values.ndim == 1:
            return RunScores(values, finite)
        sums = {self.key: values, f"runs_{self.key}": finite.astype(np.float64)}
        return RunScores(values.sum(axis=1), finite.sum(axis=1), sums)

    def of_snapshots(
        self,
        errors: Float[np.ndarray, "R K 3"],
        covs: Float[np.ndarray, "R K 3 3"],
        regular: Bool[np.ndarray, "R K"],
    ) -> Float[np.ndarray, "R"] | None:
        """The measure of each run where it takes several runs together; None of any other."""
        return None

    def average(self, per_run: Float[np.ndarray, "R"], sums: Sums) -> Average | None:
        """The average over all runs with its interval; None where no run has a number."""
        return positive_interval(per_run) if self.positive else interval(per_run)

    def pseudo_values(self, per_run: Float[np.ndarray, "R"]) -> Float[np.ndarray, "R"]:
        """Numbers of two or more runs, with the average as their mean, whose spread gives its
        standard error: the numbers themselves, unless the average is another function of them."""
        return per_run

    def curves(self, sums: Sums, runs: int) -> dict[str, np.ndarray]:
        """The curves (T,) over the steps, averages over the runs, by name; {} without sums."""
        count = sums.get(f"runs_{self.key}")
        return {} if count is None else {self.key: ratio(sums[self.key], count)}


def ratio(total: PyTree, count: np.ndarray) -> np.ndarray:
    """total / count in float64; NaN where the count is 0."""
    safe = np.where(count > 0, count, 1.0)
    return np.where(count > 0, np.asarray(total, np.float64) / safe, np.nan)
