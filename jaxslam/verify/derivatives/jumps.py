"""Outputs that jump by a whole turn between nearby states: angles that are not named as such."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxslam.verify.derivatives.differences import Batch
from jaxslam.verify.inputs.functions import PERIODS
from jaxslam.verify.inputs.samples import NOMINAL, Samples

_POINTS = 48
"""number of intervals along the line through two states"""
_BEYOND = 0.5
"""how far the line goes beyond them, relative to their distance"""
_BISECTIONS = 44
_TOLERANCE = 1e-6
"""largest difference of a jump from a turn, relative to it"""


class Jump(NamedTuple):
    """A jump of an output by a whole turn."""

    output: int
    unit: str
    """[rad] or [deg]"""
    state: tuple[Float[np.ndarray, "_"], ...]
    """where it jumps, one array an argument"""


def find_jumps(
    function: Batch, samples: Samples, periods: Float[np.ndarray, "m"]
) -> tuple[Jump, ...]:
    """The first jump by 2π or 360 of each output that is on no circle.

    The lines through successive random states are cut into intervals. In each, the jump is sought
    by bisection, always in the half in which the output changes more: at a jump the change stays as
    the interval shrinks, elsewhere it goes to zero.

    Args:
        function: of batches of arguments -> values (B, m).
        samples: the states; given or random ones are used.
        periods: of the outputs, inf of those on a line.
    """
    usual = [i for i, label in enumerate(samples.labels) if label in NOMINAL]
    starts = tuple(table[usual[:-1]] for table in samples.values)
    steps = tuple(table[usual[1:]] - table[usual[:-1]] for table in samples.values)
    grid = np.linspace(-_BEYOND, 1 + _BEYOND, _POINTS + 1)
    line = np.repeat(np.arange(len(usual) - 1), _POINTS)
    if not len(line):
        return ()

    def at(place: Float[np.ndarray, "B"]) -> tuple[Float[np.ndarray, "B n"], ...]:
        pairs = zip(starts, steps, strict=True)
        return tuple(start[line] + place[:, None] * step[line] for start, step in pairs)

    left, right = np.tile(grid[:-1], len(usual) - 1), np.tile(grid[1:], len(usual) - 1)
    ends = function(*at(left)), function(*at(right))
    found = []
    for output in np.flatnonzero(~np.isfinite(periods)):
        low, high = left, right
        at_low, at_high = (np.asarray(end, np.float64)[:, output] for end in ends)
        for _ in range(_BISECTIONS):
            centre = (low + high) / 2
            at_centre = np.asarray(function(*at(centre)), np.float64)[:, output]
            first = np.abs(at_centre - at_low) > np.abs(at_high - at_centre)
            low, high = np.where(first, low, centre), np.where(first, centre, high)
            at_low = np.where(first, at_low, at_centre)
            at_high = np.where(first, at_centre, at_high)
        change = np.abs(at_high - at_low)
        for unit, period in PERIODS.items():
            jumps = np.flatnonzero(np.abs(change - period) < _TOLERANCE * period)
            if len(jumps):
                state = tuple(table[jumps[0]] for table in at(low))
                found.append(Jump(int(output), unit, state))
                break
    return tuple(found)
