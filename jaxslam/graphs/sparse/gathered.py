"""Sums of rows by target, as gathers: no scatter, and the same order of terms on every device."""

import numpy as np
from jaxtyping import Array, Float, Int

from jaxslam.graphs.sparse.sweeps import index_table, padded_size

TERMS = 4
LEAST = 2
"""stages at least, which up to sixteen rows of a target need: fewer would be another program"""

Stages = tuple[Int[Array, "_ terms"], ...]


def stages(target: Int[np.ndarray, "rows"], size: int, room: int = 0) -> Stages:
    """The tables of sums of rows into so many targets; a target of -1 drops its row.

    With room there are four stages at least, enough for 256 rows of a target, of so many rows.

    Each stage sums up to four rows; it gives its targets in order, until each has one row.
    """
    used = np.flatnonzero(target >= 0)
    numbers = used[np.argsort(target[used], kind="stable")]
    absent, owner, out = len(target), target[numbers], list[Array]()
    while True:
        counts = np.bincount(owner, minlength=size)
        last = counts.max(initial=0) <= TERMS
        groups = np.ones(size, int) if last else -(-counts // TERMS)
        begin, group_begin = np.cumsum(counts) - counts, np.cumsum(groups) - groups
        sums = np.full((groups.sum(), TERMS), absent, np.int32)
        rank = np.arange(len(owner)) - begin[owner]
        sums[group_begin[owner] + rank // TERMS, rank % TERMS] = numbers
        done = last and len(out) + 1 >= (4 if room else LEAST)
        rows = len(sums) if done else padded_size(max(len(sums), room))
        out.append(index_table(sums, rows, absent))
        if done:
            return tuple(out)
        owner = np.repeat(np.arange(size), groups)
        numbers, absent = np.arange(len(owner)), rows


def summed(stages: Stages, rows: Float[Array, "rows *rest"]) -> Float[Array, "size *rest"]:
    """The sums of the rows of each target; zero where it has none."""
    for sums in stages:
        taken = rows.at[sums].get(mode="fill", fill_value=0)
        rows = taken[:, 0] + taken[:, 1] + (taken[:, 2] + taken[:, 3])
    return rows
