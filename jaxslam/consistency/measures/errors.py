"""Root mean square errors of position, heading and map, and those over the Cramér-Rao bound."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from jaxslam.consistency.intervals import Average, positive_interval
from jaxslam.consistency.measures.measure import Measure, Runs, RunScores, Sums, ratio


@dataclass(frozen=True, eq=False)
class Rmse(Measure):
    """The root of the mean square error. Each run's number is its mean square, in m² or rad²."""

    scale: float = 1.0
    """of the unit, from that of the squares"""

    def average(self, per_run: np.ndarray, sums: Sums) -> Average | None:
        """The root of the mean square, and those of the ends of its interval."""
        found = positive_interval(per_run)
        if found is None:
            return None
        return Average(*(self.scale * float(np.sqrt(value)) for value in found))

    def curves(self, sums: Sums, runs: int) -> dict[str, np.ndarray]:
        """The error at each step, over all runs."""
        if self.column not in sums:
            return {}
        return {self.key: self.scale * np.sqrt(ratio(sums[self.column], np.asarray(runs)))}


@dataclass(frozen=True, eq=False)
class PoseRmse(Rmse):
    """That of some coordinates of the pose, with a curve over the steps."""

    coordinates: tuple[int, int] = (0, 3)
    """of the pose, from the first to before the second"""

    def of_runs(self, runs: Runs) -> RunScores:
        """The squares, summed over the steps."""
        squares = (runs.error[..., slice(*self.coordinates)] ** 2).sum(axis=2)
        return RunScores(squares.sum(axis=1), squares.shape[1], {self.column: squares})


@dataclass(frozen=True, eq=False)
class MapRmse(Rmse):
    """That of the landmarks of the final map, unaligned; there is none of a known map."""

    def of_runs(self, runs: Runs) -> RunScores:
        """The squares, summed over the landmarks."""
        total, count = np.asarray(runs.statistics.landmark_squares).T
        return RunScores(total, count)


MEASURES = (
    PoseRmse(
        "rmse_position",
        "position RMSE",
        unit="m",
        coordinates=(0, 2),
        positive=True,
        figure="rmse",
        column="square_position",
    ),
    Measure(
        "bound_ratio_position",
        "  over conditional bound",
        honest=1,
        note=("conditional bound", "the Cramér-Rao bound of an RMSE, given the true path"),
    ),
    PoseRmse(
        "rmse_heading_deg",
        "heading RMSE",
        unit="°",
        scale=float(np.rad2deg(1.0)),
        coordinates=(2, 3),
        positive=True,
        figure="rmse",
        column="square_heading",
    ),
    Measure("bound_ratio_heading", "  over conditional bound", honest=1),
    MapRmse("rmse_landmarks", "landmark RMSE", unit="m", positive=True, column="square_landmarks"),
)

_BOUNDED = {"position": MEASURES[0], "heading": MEASURES[2]}
"""What the conditional bound is of."""


def over_bound(
    averages: Mapping[str, Average], bound: Mapping[str, np.ndarray]
) -> tuple[dict[str, Average], dict[str, np.ndarray]]:
    """The ratios of errors to their bound, and the curves of the bound; by key.

    bound: position [m²] and heading [rad²], (T,) each.
    """
    ratios, curves = {}, {}
    for name, measure in _BOUNDED.items():
        if measure.key in averages and bound[name].mean() > 0:
            least = measure.scale * np.sqrt(bound[name].mean())
            ratios[f"bound_ratio_{name}"] = Average(*(x / least for x in averages[measure.key]))
            curves[bound_curve(measure)] = measure.scale * np.sqrt(bound[name])
    return ratios, curves


def bound_curve(measure: Measure) -> str:
    """The name in `Summary.curves` of the bound of a measure, as bound_position."""
    return f"bound_{measure.key.removeprefix('rmse_')}"
