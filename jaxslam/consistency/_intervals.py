"""Averages over independent runs, with their confidence intervals."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxslam.math.stats import t_quantile

LEVEL = 0.95
"""Level of every band, and of the two tests of a verdict together."""

EACH = LEVEL**0.5
"""Level of each of the two tests, and of every interval over the runs: 97.5 %. So the intervals
show the verdict."""

_SKEW = 1.5
"""The factor by which the skewness of a run's average NEES reduces degrees of freedom; chosen by
simulation, see `Spread`."""


def percentage(share: float, digits: int = 0) -> str:
    """A share as a percentage, as in 95 %."""
    return f"{100 * share:.{digits}f} %"


class Average(NamedTuple):
    """An average over all runs, with its interval of level `EACH` from the spread between runs."""

    value: float
    low: float
    high: float


def is_lopsided(average: Average) -> bool:
    """Whether one side of the interval is over a quarter longer than the other, so that ± would
    mislead."""
    sides = sorted((average.value - average.low, average.high - average.value))
    return not sides[1] <= 1.25 * sides[0]


class Spread(NamedTuple):
    """The mean m of n positive numbers, and how far from the expectation μ it may lie.

    The statistic is Student's t with the standard error under the hypothesis: when a
    covariance is claimed c times too small, the NEES of every run, their mean and their deviation s
    all grow by c, so the deviation that belongs to μ is s μ/m. With u = s/(m √n),

        m/μ - 1 + u²/2 lies within ± q u,     q = t_{1 - (1 - level)/2} with (n - 1)/f dof,

    hence μ between m/(1 + q u - u²/2) and m/(1 - q u - u²/2): never negative, longer above than
    below, as the average of a skewed quantity is. u²/2 centres the statistic where the skewness is
    three times s/m: about so skewed is a run's average NEES (the χ² of the common factor of its
    steps has 2 s/m, a sum of a constant and such a χ² more). f = `_SKEW` accounts for the spread of
    s for skewed numbers, and 1 is for numbers whose spread is small. Calibrated by simulation:
    `python -m benchmarks --record --only verdict`.
    """

    mean: float
    error: float
    """u, the relative standard error of the mean; infinite for a single number"""
    reach: float
    """q u"""

    @property
    def above(self) -> float:
        """The ratio m/μ at the lower end of the interval."""
        return max(1 + self.reach - self.error**2 / 2, 1.0)

    @property
    def below(self) -> float:
        """The ratio m/μ at its upper end; 0 where it has none."""
        return max(1 - self.reach - self.error**2 / 2, 0.0)

    @property
    def low(self) -> float:
        """The lower end."""
        return self.mean / self.above

    @property
    def high(self) -> float:
        """The upper end; infinite where so few numbers do not bound the mean."""
        return self.mean / self.below if self.below > 0 else np.inf


def spread(
    values: np.ndarray | Sequence[float], level: float = EACH, skewed: bool = True
) -> Spread | None:
    """The mean of positive numbers, one an independent run, NaN left out; None without any.

    skewed: f = `_SKEW`, else 1; see `Spread`.
    """
    finite = _numbers(values)
    if finite.size == 0:
        return None
    mean = float(finite.mean())
    if finite.size < 2:
        return Spread(mean, np.inf, np.inf)
    error = float(finite.std(ddof=1) / mean / np.sqrt(finite.size)) if mean > 0 else 0.0
    dof = (finite.size - 1) / (_SKEW if skewed else 1.0)
    return Spread(mean, error, t_quantile(0.5 + level / 2, dof) * error)


def positive_interval(
    values: np.ndarray | Sequence[float], level: float = EACH, skewed: bool = True
) -> Average | None:
    """The mean of positive numbers with the interval of `Spread`; None without numbers.

    Of a single number the interval is all that is positive, (0, ∞).
    """
    average = spread(values, level, skewed)
    if average is None:
        return None
    if not np.isfinite(average.error):
        return Average(average.mean, 0.0, np.inf)
    return Average(average.mean, average.low, average.high)


def interval(values: np.ndarray | Sequence[float], level: float = EACH) -> Average | None:
    """Mean of independent runs with its t interval, NaN left out; None where nothing is left.

    For what may be of either sign; what cannot be negative has `positive_interval`.
    """
    finite = _numbers(values)
    if finite.size == 0:
        return None
    mean = float(finite.mean())
    if finite.size < 2:
        return Average(mean, -np.inf, np.inf)
    half = t_quantile(0.5 + level / 2, finite.size - 1) * finite.std(ddof=1) / np.sqrt(finite.size)
    return Average(mean, mean - float(half), mean + float(half))


def _numbers(values: np.ndarray | Sequence[float]) -> np.ndarray:
    numbers = np.asarray(values, np.float64)
    return numbers[np.isfinite(numbers)]
