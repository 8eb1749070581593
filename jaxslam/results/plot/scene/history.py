"""What a film shows of a run: everything of the steps that are frames, and little of the others."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxslam.core.numbers import check_count
from jaxslam.core.types import Estimate, Log, Status, Trace
from jaxslam.core.validation import check_record
from jaxslam.results.plot.scene.probe import Cloud, Hypotheses, Links

MOST = 100
"""default of the largest number of frames"""


def frame_steps(
    steps: int, most: int = MOST, time: Float[np.ndarray, "T"] | None = None
) -> Int[np.ndarray, "F"]:
    """The steps 0 … steps - 1 that are shown: all, or `most` of them, evenly in time.

    The first and the last are shown. time: of each step, which does not go back; default: evenly in
    steps. In a gap of the times a step is shown several times.

    Raises ValueError without a step, on a `most` below 1, or on other times.
    """
    if steps < 1:
        raise ValueError(f"animate: expected at least one step, got {steps}")
    check_count("animate: frames", most)
    time = np.arange(steps, dtype=float) if time is None else np.asarray(time, float)
    if time.shape != (steps,) or not np.isfinite(time).all() or (np.diff(time) < 0).any():
        raise ValueError(f"animate: expected {steps} finite times that do not go back")
    if steps <= most:
        return np.arange(steps)
    if most == 1:
        return np.array([steps - 1])
    at = np.searchsorted(time, np.linspace(time[0], time[-1], most), side="right") - 1
    at[0], at[-1] = 0, steps - 1
    return at


class History(NamedTuple):
    """A run of T steps, of which F are frames; NumPy arrays."""

    path: Float[np.ndarray, "T 3"]
    """the estimated pose of every step"""
    step: Int[np.ndarray, "F"]
    """the step of each frame, from 0"""
    estimate: Estimate
    """with leading F"""
    tag: Int[np.ndarray, "T M"]
    """of the measurements"""
    status: Int[np.ndarray, "T M"]
    slot: Int[np.ndarray, "T M"]
    seen: Cloud | Links | Hypotheses | None = None
    """with leading F"""


def history_of(trace: Trace, log: Log, frames: int = MOST) -> History:
    """The history of a trace, at `frame_steps`.

    Raises ValueError on a trace that is not of one run over this log, or has no step.
    """
    check_record("animate", "trace", trace, Trace)
    check_record("animate", "log", log, Log)
    path, status = np.asarray(trace.estimate.pose), np.asarray(trace.info.status)
    if path.ndim != 2 or path.shape[1] != 3:
        raise ValueError(
            f"animate: expected the trace of one run, with poses (T, 3), got {path.shape}"
        )
    steps = frame_steps(len(path), frames)
    rows = np.shape(log.control)[0]
    if rows != len(path) or np.shape(log.scan.tag) != status.shape:
        raise ValueError(
            f"animate: expected the log of the trace, of {len(path)} steps and measurements "
            f"{status.shape}, got {rows} steps and measurements {np.shape(log.scan.tag)}"
        )
    estimate, seen = jax.tree.map(
        lambda leaf: np.asarray(leaf)[steps], (trace.estimate, trace.probe)
    )
    tag, slot = np.asarray(log.scan.tag), np.asarray(trace.info.slot)
    return History(path, steps, estimate, tag, status, slot, seen)


class Measured(NamedTuple):
    """The measurements of the steps since the frame before, of each of F frames."""

    beams: dict[str, list[Float[np.ndarray, "E 2 2"]]]
    """by what became of them: from the robot to the landmark, of those that have one in the map"""
    counts: dict[str, Int[np.ndarray, "F"]]
    """how many there are, by the same"""


_OUTCOMES = {
    "fused": (Status.FUSED,),
    "new": (Status.BORN,),
    "stored": (Status.SIGHTED,),
    "dropped": tuple(set(Status) - {Status.EMPTY, Status.FUSED, Status.BORN, Status.SIGHTED}),
}


def measured(history: History) -> Measured:
    """The beams and counts of a history.

    A beam begins where the robot was estimated in that step, and ends at the landmark's estimate in
    the frame. A dropped measurement has the landmark of its tag, where that is in the map.
    """
    beams: dict[str, list[np.ndarray]] = {name: [] for name in _OUTCOMES}
    counts: dict[str, list[int]] = {name: [] for name in _OUTCOMES}
    before = 0
    for k, step in enumerate(history.step):
        rows = slice(before, step + 1)
        before = step + 1
        status, slot, tag = history.status[rows], history.slot[rows], history.tag[rows]
        points, alive = history.estimate.points[k], np.asarray(history.estimate.alive[k])
        named = alive & (history.estimate.tag[k] >= 0)
        match = (tag[..., None] == history.estimate.tag[k]) & named
        by_tag = np.where(match.any(axis=-1), match.argmax(axis=-1), -1) if named.size else -1
        target = np.where(slot >= 0, slot, by_tag)
        there = (target >= 0) & (target < len(alive))
        there &= np.append(alive, False)[np.where(there, target, -1)]
        for name, outcomes in _OUTCOMES.items():
            mine = np.isin(status, outcomes)
            counts[name].append(int(mine.sum()))
            row, at = np.nonzero(mine & there)
            ends = [history.path[rows][row, :2], np.asarray(points)[target[row, at]]]
            beams[name].append(np.stack(ends, axis=1))
    return Measured(beams, {name: np.array(found) for name, found in counts.items()})
