"""Signs that angles are in degrees where radians are declared."""

import numpy as np
from jaxtyping import Float

TURN = 2 * np.pi
_ROWS = 1000
"""Rows of a path that are compared; a longer one is thinned."""


def are_headings_in_degrees(path: Float[np.ndarray, "K 3"]) -> bool:
    """Whether the headings of a path (x, y, θ) fit its positions in degrees, and not in radians.

    A robot moves along its axis, ahead or back. With φ the direction of a step, w its length and h
    the heading halfway, the agreement Σ w cos 2(φ - h) / Σ w is 1 then, and about 0 for headings
    that have nothing to do with the steps. Degrees have headings beyond ±2π, an agreement above 0.9
    as degrees and below 0.5 as radians, and disagree by less than a quarter of what a constant
    heading does: a robot that spins on its way along x agrees with headings near 0. A path that
    does not turn, or of a robot that moves sideways, shows nothing.
    """
    path = path[np.isfinite(path).all(axis=1)]
    if len(path) < 2 or np.abs(path[:, 2]).max() <= TURN:
        return False
    x, y, heading = path[:: -(-len(path) // _ROWS)].T
    step = np.diff(x) + 1j * np.diff(y)
    if not (length := np.abs(step)).any():
        return False
    along = step**2 / np.where(length > 0, length, 1.0)  # w exp(2iφ)

    def agreement(angle: Float[np.ndarray, "K"]) -> float:
        axis = np.exp(1j * angle)
        return float((along * np.conj(axis[:-1] * axis[1:])).real.sum() / length.sum())

    as_degrees, constant = agreement(np.deg2rad(heading)), abs(along.sum()) / length.sum()
    explained = 1 - as_degrees < 0.25 * (1 - constant)
    return bool(as_degrees > 0.9 and explained and agreement(heading) < 0.5)
