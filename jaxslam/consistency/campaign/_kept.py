"""Finished blocks as they are kept: saved by a store, added to the tallies of filters."""

from collections.abc import Callable, Iterable, Mapping
from typing import Protocol

import numpy as np

from jaxslam.consistency._tally import Tally


class Keep(Protocol):
    """The store of finished blocks, as of `jaxslam.store.open`. Claimed before it is read."""

    def claim(self, identity: Mapping[str, str]) -> None:
        """Note what campaign this is, once; ValueError where it is another that was noted."""

    def save(self, first: int, arrays: Mapping[str, np.ndarray], runs: int) -> object:
        """Keep runs first … first + runs - 1."""

    def blocks(self) -> Iterable[tuple[int, int, Mapping[str, np.ndarray]]]:
        """The blocks kept, each as (first, runs, arrays)."""


def add_kept(
    tallies: dict[str, Tally], keep: Keep, runs: int, wanted: Callable[[int], bool]
) -> list[tuple[int, int]]:
    """Add the blocks kept whose first run is wanted; (first, runs) of all of them.

    Raises ValueError on stored runs beyond the requested ones.
    """
    finished: list[tuple[int, int]] = []
    most = 0
    for first, count, arrays in keep.blocks():
        most = max(most, first + count)
        if most > runs:  # sums over a block cannot be taken apart; look how many runs there are
            continue
        finished.append((first, count))
        if wanted(first):
            add_block(tallies, first, count, by_filter(arrays, tallies))
    if most > runs:
        raise ValueError(
            f"monte_carlo: runs: expected at least {most}, as many as keep holds, got {runs}"
        )
    return finished


def add_block(
    tallies: dict[str, Tally], first: int, runs: int, scores: dict[str, dict[str, np.ndarray]]
) -> None:
    """Add the arrays of a block to the tally of each filter."""
    for name, arrays in scores.items():
        tallies[name].add(first, runs, arrays)


def flatten(
    scores: dict[str, dict[str, np.ndarray]], names: Iterable[str]
) -> dict[str, np.ndarray]:
    """The arrays of all filters in one mapping, by "position/name"."""
    return {
        f"{i}/{key}": array
        for i, name in enumerate(names)
        for key, array in scores.get(name, {}).items()
    }


def by_filter(
    arrays: Mapping[str, np.ndarray], names: Iterable[str]
) -> dict[str, dict[str, np.ndarray]]:
    """The inverse of `flatten`."""
    scores: dict[str, dict[str, np.ndarray]] = {}
    order = list(names)
    for label, array in arrays.items():
        i, _, key = label.partition("/")
        scores.setdefault(order[int(i)], {})[key] = array
    return scores
