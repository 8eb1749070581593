"""Measures of a monitored filter: the unobservable directions of its linearized system."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, PyTree

from jaxslam.consistency._measures.measure import Measure, Runs, RunScores
from jaxslam.filters._ekf.monitor import Monitor, MonitoredState


@dataclass(frozen=True, eq=False)
class Unobservable(Measure):
    """The dimension of the unobservable subspace at the end of a run."""

    def of_runs(self, runs: Runs) -> RunScores | None:
        """The dimension in each run."""
        monitor = monitor_of(runs.trace.final)
        return None if monitor is None else RunScores(unobservable_directions(monitor), 1)


@dataclass(frozen=True, eq=False)
class RotationInformation(Measure):
    """The information gained on a rotation of the whole frame by the end of a run."""

    def of_runs(self, runs: Runs) -> RunScores | None:
        """The information by the end of each run, and its curve."""
        monitor = monitor_of(runs.trace.final)
        if monitor is None:
            return None
        information, turn = runs.trace.probe.astype(np.float64), monitor.turn
        gained = np.einsum("rtij,ri,rj->rt", information, turn, turn)
        sums = {self.key: gained, f"runs_{self.key}": np.ones_like(gained)}
        return RunScores(gained[:, -1], 1, sums)


MEASURES = (
    Unobservable(
        "unobservable",
        "unobservable directions",
        honest=3,
        note=(
            "unobservable directions",
            "dimension of what the filter's own linearized system leaves open; 3 in SLAM, two of "
            "position and one of rotation of robot and map together",
        ),
    ),
    RotationInformation(
        "rotation_information",
        "rotation information",
        unit="1/rad²",
        honest=0,
        figure="gained",
        axis="information [1/rad²]",
        note=(
            "rotation information",
            "what the filter has learnt of a rotation of robot and map together, which no "
            "measurement contains",
        ),
    ),
)


def monitor_of(state: PyTree) -> Monitor | None:
    """The observability monitor in the state of a `monitored` filter; None in another state."""
    return state.monitor if isinstance(state, MonitoredState) else None


def unobservable_directions(monitor: Monitor) -> Int[np.ndarray, "R"]:
    """The dimension of the unobservable subspace of the filter's linearized system.

    A direction is unobservable if the information along it is below 1e-9 of the same sum of squares
    with absolute values, in float32 eps^(3/4): rounding leaves 1e-32 of it, the higher moments that
    sigma points do not see 1e-10, an EKF's changing Jacobians 1e-5 after a hundred steps.
    """
    gained: Float[np.ndarray, "R n n"] = np.asarray(monitor.information)
    least = max(1e-9, float(np.finfo(gained.dtype).eps) ** 0.75)
    scale = np.sqrt(np.where(monitor.scale > 0, monitor.scale, 1.0).astype(np.float64))
    unit = gained / scale[:, :, None] / scale[:, None, :]
    regular = np.isfinite(unit).all(axis=(1, 2))
    size = np.linalg.eigvalsh(np.where(regular[:, None, None], unit, 0.0))
    below: np.ndarray = (size < least).sum(axis=1)
    return below
