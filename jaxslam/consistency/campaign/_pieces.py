"""Remaining runs, split at block borders; number of usable cores."""

import os
from collections.abc import Iterable
from typing import Any

from jaxslam.core._numbers import is_whole
from jaxslam.core.validation import InvalidField


def missing_pieces(
    finished: Iterable[tuple[int, int]], runs: int, block: int
) -> list[tuple[int, int]]:
    """The unfinished pieces (first, runs) of runs 0 … runs-1, in order, split at block borders:
    each is within runs n block … (n + 1) block - 1 for some n.

    finished: (first, runs) of finished pieces, in any order; may overlap and exceed runs.
    """
    if block < 1:
        raise InvalidField("block", f"expected an integer >= 1, got {block}")
    gaps, at = [], 0
    for first, count in [*sorted(finished), (runs, 0)]:
        gaps.append((at, min(first, runs)))
        at = max(at, first + count)
    return [
        (max(first, begin), min(first + block, end) - max(first, begin))
        for begin, end in gaps
        if begin < end
        for first in range(begin // block * block, end, block)
    ]


def one_part(value: Any) -> tuple[int, int]:
    """The check of a part (i, n) of a campaign, 1 <= i <= n."""
    is_pair = isinstance(value, tuple) and len(value) == 2 and all(map(is_whole, value))
    if not is_pair or not 1 <= value[0] <= value[1]:
        raise ValueError(f"expected (i, n) with 1 <= i <= n, got {value!r}")
    part: tuple[int, int] = value
    return part


def in_part(first: int, block: int, part: tuple[int, int] | None) -> bool:
    """Whether the block of run `first` is one of part (i, n): blocks i - 1, i - 1 + n, … from 0 on.

    Thus the parts of a campaign depend neither on finished runs nor on the number of runs.
    """
    return part is None or first // block % part[1] == part[0] - 1


def cores() -> int:
    """The number of CPU cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity is not None else os.cpu_count() or 1
