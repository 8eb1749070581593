"""Which steps of a run are the frames of a film, and how fast they follow."""

import numpy as np
from jaxtyping import Float, Int

from jaxslam.core.numbers import check_count

MOST = 250
"""default of the largest number of frames: 10 s at 25 frames a second"""

SECONDS, FASTEST, SLOWEST = 10.0, 25.0, 2.0
"""A film lasts 10 s, unless it would have more than 25 or fewer than 2 frames a second."""


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


def pace(frames: int) -> float:
    """The number of frames a second of a film of so many frames."""
    return float(np.clip(frames / SECONDS, SLOWEST, FASTEST))
