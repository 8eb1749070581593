"""The beams of a laser log from the ranges and angles of its scans."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from jaxtyping import Float

from jaxslam.core.types import Beams
from jaxslam.datasets._account import Account


class RangeScan(Protocol):
    """The parts of a scan of n beams that are read."""

    @property
    def ranges(self) -> Float[np.ndarray, "n"]:
        """[m], 0 where the beam has none."""

    @property
    def angles(self) -> Float[np.ndarray, "n"]:
        """[rad] in the frame of the laser."""

    @property
    def limit(self) -> float:
        """Maximum range in the file [m], infinite if it has none."""

    @property
    def bad_limit(self) -> bool:
        """Whether the file has a maximum range that is not finite and above 0."""


def beams_of(scans: Sequence[RangeScan], max_range: float, account: Account) -> tuple[Beams, float]:
    """The beams (K, B), and the range of beams without a return [m]."""
    width = max(len(scan.ranges) for scan in scans)
    ranges, angles = np.zeros((2, len(scans), width))
    present = np.zeros((len(scans), width), bool)
    for k, scan in enumerate(scans):
        count = len(scan.ranges)
        ranges[k, :count], angles[k, :count], present[k, :count] = scan.ranges, scan.angles, True
    valid = present & (ranges > 0)
    account.drop("beams without a range", (present & ~valid).sum())
    limits = np.minimum([scan.limit for scan in scans], max_range)
    if (code := _code_of_no_return(ranges[valid & (ranges < limits[:, None])])) is not None:
        account.correct(
            f"ranges of {code:.2f} m or more are read as no return: the log has many of one value, "
            "and hardly any just below it"
        )
        limits = np.minimum(limits, code)
    unstated = sum(scan.bad_limit for scan in scans)
    account.correct(
        f"scans without a maximum range above 0, which take max_range: {unstated}", unstated
    )
    limit = float(limits.max())
    account.correct(
        f"maximum ranges differ, the smallest is {limits.min():g} m: a beam beyond that of its "
        f"scan has no return and is set to {limit:g} m",
        (limits < limit).any(),
    )
    ranges = np.where(ranges >= limits[:, None], limit, ranges)
    return Beams(np.where(valid, ranges, 0.0), angles, valid), limit


_LEAST_CODED = 1000
"""Ranges from which on a code is looked for."""


def _code_of_no_return(ranges: Float[np.ndarray, "n"]) -> float | None:
    """The range that codes "no return" [m], of a laser that reports it as its largest range.

    None unless the last hundredth of the largest range has more than one beam in 500, ten times as
    many as the tenth below it, and two values are 93 % of them: ranges of a wall have noise, but a
    code is one number, or two after a conversion of units.
    """
    if len(ranges) < _LEAST_CODED:
        return None
    code = 0.99 * float(ranges.max())
    last = ranges[ranges >= code]
    below = int(((ranges < code) & (ranges >= 0.9 * code)).sum())
    if len(last) <= max(len(ranges) / 500, 10 * below):
        return None
    _, count = np.unique(last, return_counts=True)
    return code if np.sort(count)[-2:].sum() > 0.93 * len(last) else None
