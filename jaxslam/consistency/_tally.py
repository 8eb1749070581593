"""`condense` reduces a block of scores to its sums, and a `Tally` adds such blocks up.

Called by `monte_carlo`: `block` condenses, `campaign` adds in any order and keeps the tallies, and
`summary.summarize` takes them.

Sums over runs are taken in pairs of float64 (106 bits), so that what they are rounded to does not
depend on how the runs were divided; Knuth's two-sum, and the sums of Dekker 1971 ("A floating-point
technique for extending the available precision", Numerische Mathematik 18).
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from jaxslam.consistency._run_scores import Score

FAR = 5.0
"""Standard deviations √tr P of the position beyond which a final error is far: of a normal error
with equal deviations in x and y that is exp(-25) of the runs, 1e-11."""

SHOTS = 2048
"""Snapshots are kept of runs with numbers below this."""


class Sum(NamedTuple):
    """A sum high + low, where low is the rounding error of high."""

    high: np.ndarray
    low: np.ndarray


def plus(a: Sum, b: Sum) -> Sum:
    """The sum a + b, to about 2⁻¹⁰⁴ of |a| + |b|."""
    high, error = _two_sum(a.high, b.high)
    low, last = _two_sum(a.low, b.low)
    high, error = _renormalize(high, error + low)
    return Sum(*_renormalize(high, error + last))


def sum_rows(rows: np.ndarray) -> Sum:
    """The sum over the leading axis, which may be empty."""
    rows = np.asarray(rows, np.float64)
    if len(rows) == 0:
        return Sum(np.zeros(rows.shape[1:]), np.zeros(rows.shape[1:]))
    parts = Sum(rows, np.zeros_like(rows))
    while len(parts.high) > 1:
        even = len(parts.high) // 2 * 2
        halves = plus(Sum(*(part[:even:2] for part in parts)), Sum(*(p[1:even:2] for p in parts)))
        odd = (part[even:] for part in parts)
        parts = Sum(*(np.concatenate(pair) for pair in zip(halves, odd, strict=True)))
    return Sum(parts.high[0], parts.low[0])


def condense(scores: Score, first: int, limit: float) -> dict[str, np.ndarray]:
    """The arrays that a tally keeps of runs first, first + 1, … (leading axis), by name.

    A finite run is inaccurate when its final position error exceeds limit [m], and divergent when
    it also exceeds 5 σ of what the filter claims, σ² = tr P of the position (`FAR`).
    """
    runs, finite = len(scores.finite), np.asarray(scores.finite)

    def without_lost(rows: np.ndarray) -> np.ndarray:
        rows = np.asarray(rows)
        return np.where(finite.reshape(-1, *(1,) * (rows.ndim - 1)), rows, np.zeros_like(rows))

    snapshots = [without_lost(leaf) for leaf in scores.snapshots]
    last = np.sqrt((snapshots[0][:, -1, :2] ** 2).sum(axis=1))
    claimed = np.trace(snapshots[1][:, -1, :2, :2], axis1=1, axis2=2, dtype=np.float64)
    inaccurate = finite & (last > limit)
    beyond = last > FAR * np.sqrt(np.maximum(claimed, 0.0))
    block = {"finite": finite, "inaccurate": inaccurate, "divergent": inaccurate & beyond}
    for name, (total, weight) in scores.measures.items():
        total, weight = without_lost(total), without_lost(weight).astype(total.dtype)
        block[f"defined/{name}"] = weight > 0
        block[f"measure/{name}"] = total / np.where(weight > 0, weight, 1)
    kept = max(min(runs, SHOTS - first), 0)
    for i, leaf in enumerate(snapshots):
        block[f"snapshot/{i}"] = leaf[:kept]
    return block | condensed_sums({name: without_lost(rows) for name, rows in scores.sums.items()})


def condensed_sums(per_run: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The sums over the runs of named arrays, as `Tally.add` takes them."""
    sums = {}
    for name, rows in per_run.items():
        sums[f"high/{name}"], sums[f"low/{name}"] = sum_rows(np.asarray(rows))
    return sums


class Tally:
    """The sum of condensed blocks of scores, added in any order."""

    def __init__(self) -> None:
        self._sums: dict[str, Sum] = {}
        self._blocks: dict[int, dict[str, np.ndarray]] = {}
        """arrays by first run; blocks that follow each other are joined"""
        self._runs: dict[int, int] = {}
        self._begins: dict[int, int] = {}
        """first run of the block that ends at a run"""

    def add(self, first: int, runs: int, block: dict[str, np.ndarray]) -> None:
        """Add what `condense` returned of runs first … first + runs - 1."""
        kept = {}
        for name, value in block.items():
            kind, _, key = name.partition("/")
            if kind == "high":
                new = Sum(value, block[f"low/{key}"])
                self._sums[key] = plus(self._sums[key], new) if key in self._sums else new
            elif kind != "low":
                kept[name] = value
        self._place(first, runs, kept)
        self._join(first)

    def merge(self, tally: "Tally") -> None:
        """Add the blocks of another tally, of other runs."""
        for name, value in tally._sums.items():
            self._sums[name] = plus(self._sums[name], value) if name in self._sums else value
        for first, runs in tally._runs.items():
            self._place(first, runs, tally._blocks[first])

    def _place(self, first: int, runs: int, block: dict[str, np.ndarray]) -> None:
        self._blocks[first], self._runs[first] = block, runs
        self._begins[first + runs] = first

    def _join(self, first: int) -> None:
        """Join a block with its neighbours, as long as these have no more runs.

        So arrays are few, each run is copied a logarithm of times, and a campaign keeps little more
        than the numbers: an array of 16 numbers takes four times the memory of the numbers.
        """
        while True:
            runs = self._runs[first]
            left, right = self._begins.get(first), first + runs
            if left is not None and self._runs[left] <= runs:
                pair = left, first
            elif right in self._runs and self._runs[right] <= runs:
                pair = first, right
            else:
                return
            runs = sum(self._runs.pop(begin) for begin in pair)
            before, after = (self._blocks.pop(begin) for begin in pair)
            joined = {
                name: np.concatenate([value, after[name]]) if value.ndim else value
                for name, value in before.items()
            }
            del self._begins[pair[1]]
            first = pair[0]
            self._place(first, runs, joined)

    @property
    def sums(self) -> dict[str, np.ndarray]:
        """The sums over all runs, rounded to float64."""
        return {name: value.high + value.low for name, value in self._sums.items()}

    def pieces(self) -> list[tuple[int, int]]:
        """The pieces (first, runs) that the blocks cover, in order; adjacent blocks may be one."""
        return sorted(self._runs.items())

    def numbers(self) -> np.ndarray:
        """The numbers of the runs (runs,), in order."""
        return _joined(np.arange(first, first + runs) for first, runs in self.pieces())

    def block(self) -> dict[str, np.ndarray]:
        """What `add` takes of all runs at once: their sums and arrays by name."""
        arrays = next(iter(self._blocks.values()))
        kept = {name: self._all(name) if value.ndim else value for name, value in arrays.items()}
        high = {f"high/{name}": value.high for name, value in self._sums.items()}
        return kept | high | {f"low/{name}": value.low for name, value in self._sums.items()}

    def flags(self, name: str) -> np.ndarray:
        """Whether each run is finite, inaccurate, or divergent: flags (runs,)."""
        return self._all(name)

    def first(self, name: str) -> np.ndarray:
        """A named array of the first block."""
        return self._blocks[min(self._blocks)][name]

    def measures(self) -> dict[str, np.ndarray]:
        """Each run's average (runs,), NaN where it has none."""
        some = next(iter(self._blocks.values()))
        names = [name.removeprefix("measure/") for name in some if name.startswith("measure/")]
        return {
            name: np.where(
                self._all(f"defined/{name}"),
                self._all(f"measure/{name}").astype(np.float64),
                np.nan,
            )
            for name in names
        }

    def snapshots(self) -> list[np.ndarray]:
        """Errors (R, K, 3), covariances (R, K, 3, 3), regular (R, K), of the first finite runs."""
        parts = [self._all(f"snapshot/{i}") for i in range(3)]
        finite = self.flags("finite")[self.numbers() < SHOTS]
        return [part[finite] for part in parts]

    def _all(self, name: str) -> np.ndarray:
        return _joined(self._blocks[first][name] for first in sorted(self._blocks))


def _joined(parts: Iterable[np.ndarray]) -> np.ndarray:
    return np.concatenate(list(parts))


def _two_sum(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The sum a + b rounded, and the exact error of that rounding."""
    high = a + b
    b_in_high = high - a  # what is left of b once the sum is rounded
    return high, (a - (high - b_in_high)) + (b - b_in_high)


def _renormalize(high: np.ndarray, low: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The sum high + low rounded, and the exact error of that rounding, for |high| >= |low|."""
    total = high + low
    return total, low - (total - high)
