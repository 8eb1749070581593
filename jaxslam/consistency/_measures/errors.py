"""Root mean square errors of position, heading and map, and those over the Cramér-Rao bound."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from jaxslam.consistency._intervals import Average, positive_interval
from jaxslam.consistency._measures.measure import Better, Measure, Runs, RunScores, Sums, ratio


@dataclass(frozen=True, eq=False)
class Rmse(Measure):
    """The root of the mean square error. Each run's number is its mean square, in m² or rad²."""

    positive: bool = True
    scale: float = 1.0
    """factor from the root of the squares to the unit"""
    coordinates: tuple[int, int] | None = None
    """range [first, end) of the pose's coordinates; None: points of the final map"""
    final: bool = False
    """of the last step alone"""
    better: Better = "smaller"

    def of_runs(self, runs: Runs) -> RunScores:
        """The squares, summed over the steps or over the landmarks."""
        if self.coordinates is None:
            return RunScores(*np.asarray(runs.statistics.landmark_squares).T)
        squares = (runs.error[..., slice(*self.coordinates)] ** 2).sum(axis=2)
        if self.final:
            return RunScores(squares[:, -1], 1)
        return RunScores(squares.sum(axis=1), squares.shape[1], {self.column: squares})

    def average(self, per_run: np.ndarray, sums: Sums) -> Average | None:
        """The root of the mean square, and the roots of the ends of its interval."""
        mean_square = positive_interval(per_run)
        return mean_square and Average(
            *(self.scale * float(np.sqrt(value)) for value in mean_square)
        )

    def pseudo_values(self, per_run: np.ndarray) -> np.ndarray:
        """Numbers of the runs whose mean is the RMSE, by the delta method.

        With r² = mean of the squares s, √(r² + δ) = r + δ/(2r) to first order: (r² + s)/(2r).
        """
        mean_square = per_run.mean()
        root = np.sqrt(mean_square)
        values: np.ndarray = self.scale * (mean_square + per_run) / (2 * root if root > 0 else 1.0)
        return values

    def curves(self, sums: Sums, runs: int) -> dict[str, np.ndarray]:
        """The error at each step, over all runs."""
        if self.column not in sums:
            return {}
        return {self.key: self.scale * np.sqrt(ratio(sums[self.column], np.asarray(runs)))}


_POSITION = Rmse(
    "rmse_position",
    "position RMSE",
    unit="m",
    coordinates=(0, 2),
    figure="rmse",
    column="square_position",
)

HEADING = Rmse(
    "rmse_heading_deg",
    "heading RMSE",
    unit="°",
    scale=float(np.rad2deg(1.0)),
    coordinates=(2, 3),
    figure="rmse",
    column="square_heading",
)

_BOUND = "conditional bound", "the Cramér-Rao bound of an RMSE, given the true path"

MEASURES = (
    _POSITION,
    Measure("bound_ratio_position", "  over conditional bound", honest=1, note=_BOUND),
    HEADING,
    Measure("bound_ratio_heading", "  over conditional bound", honest=1),
    Rmse(
        "rmse_final",
        "final position RMSE",
        unit="m",
        coordinates=(0, 2),
        final=True,
        column="square_final",
        row=False,
    ),
    Rmse("rmse_landmarks", "landmark RMSE", unit="m", column="square_landmarks"),
)


def over_bound(
    averages: Mapping[str, Average], bound: Mapping[str, np.ndarray]
) -> tuple[dict[str, Average], dict[str, np.ndarray]]:
    """The ratios of errors to their bound, and the curves of the bound; by key.

    bound: position [m²] and heading [rad²], (T,) each.
    """
    ratios, curves = {}, {}
    for name, measure in (("position", _POSITION), ("heading", HEADING)):
        if measure.key in averages and bound[name].mean() > 0:
            least = measure.scale * np.sqrt(bound[name].mean())
            ratios[f"bound_ratio_{name}"] = Average(*(x / least for x in averages[measure.key]))
            curves[bound_curve(measure)] = measure.scale * np.sqrt(bound[name])
    return ratios, curves


def bound_curve(measure: Measure) -> str:
    """The name in `Summary.curves` of the bound of a measure, as bound_position."""
    return f"bound_{measure.key.removeprefix('rmse_')}"
