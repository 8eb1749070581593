"""Sums of products of blocks, as loops over tables of fixed shape.

A factorization, a substitution and a selected inversion have one form: target blocks, from each of
which a sum of products of finished blocks is subtracted before it is finished. Targets that do not
depend on each other make a level. A level is done in rounds: round r subtracts the products rK to
rK + K - 1 of each target that has so many. The targets of a level are sorted by their number of
products, so that the targets of a round are the first of the level and lie side by side in memory:
no scatter is needed, and the size of the compiled program does not depend on the graph.

Tables and arrays are longer than they need be (`padded_size`), so that patterns of about one size
share their compiled programs: rows beyond the last level are not visited.

Sums of rows by target are gathers: no scatter, and the same order of terms on every device.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

TARGETS = 8
"""T, targets that are computed together"""
_TERMS = 2
"""K, products of a target that are computed together"""

_PART = 1 << 12
"""Chunks whose tables are made at once: a large graph has some hundred thousand of them."""

Ints = Int[np.ndarray, "_"]
_Product = Callable[[Array, Array], Array]


class Sums(NamedTuple):
    """The M targets of a sweep, and the P products that are subtracted from them."""

    level: Ints
    """level of each target, from 0, (M,)"""
    target: Ints
    """target of each product, (P,)"""
    left: Ints
    """the left factor of each product, (P,)"""
    right: Ints
    """the right factor of each product, (P,)"""
    flip: Bool[np.ndarray, "_"] | None = None
    """whether the left factor is transposed, (P,)"""


class Sweep(NamedTuple):
    """The tables of a sweep: C chunks of products and F chunks of finished targets.

    A chunk is of T targets side by side, and of up to K products of each.
    """

    levels: Int[Array, ""]
    rounds: Int[Array, "levels+1"]
    """the first chunk of products of each level, and the end of the last"""
    base: Int[Array, "C"]
    """the first place of each chunk"""
    left: Int[Array, "C T K"]
    right: Int[Array, "C T K"]
    ends: Int[Array, "levels+1"]
    """the first chunk of finished targets of each level, and the end of the last"""
    end_base: Int[Array, "F"]
    end: Int[Array, "F T"]
    """the operation that finishes a target"""
    flip: Bool[Array, "C T K"] | None
    """whether the left factor is transposed"""


def padded_size(size: int, least: int = 64, parts: int = 8) -> int:
    """The next size of a coarser series: multiples of `least`, and of the `parts` of an octave.

    A size of the series stays as it is, and so does zero.
    """
    step = max(least, (1 << max(size.bit_length() - 1, 0)) // parts)
    return -(-size // step) * step


def padded_table_size(size: int, room: int = 0) -> int:
    """The padded size of a table, at least `room`; rows beyond its size cost only memory."""
    return padded_size(max(size, room), parts=2)


def index_table(numbers: np.ndarray, size: int | None = None, fill: int = 0) -> Array:
    """A table of integers or flags on the device, padded to a number of rows."""
    kept = numbers if numbers.dtype == bool else numbers.astype(np.int32, copy=False)
    if size is not None:
        beyond = [(0, size - len(kept))] + [(0, 0)] * (kept.ndim - 1)
        kept = np.pad(kept, beyond, constant_values=fill)
    return jnp.asarray(jax.device_put(kept))


def level_table(ends: Sequence[int], room: int = 0) -> Array:
    """The end of each level, from 0, as a table with room for more variables.

    With room there are a quarter as many levels as variables at least.
    """
    return index_table(np.array(ends), padded_table_size(len(ends), room // 4))


def places(sums: Sums, size: int) -> tuple[Ints, Ints]:
    """The target at each place (M,), and the place of each target and of no target (M+1,).

    Targets of a level lie side by side, those with most products first. size: of the array of
    targets, at least M.
    """
    count = np.bincount(sums.target, minlength=len(sums.level))
    order = np.lexsort((-count, sums.level))
    place = np.empty(len(order) + 1, int)
    place[order] = np.arange(len(order))
    place[-1] = no_place(size)
    return order, place


def no_place(size: int) -> int:
    """The place in an array of targets that is always zero (or the identity)."""
    return size + TARGETS


def pad_targets(array: jax.Array) -> jax.Array:
    """The array (M, …) with zeros for the overhang of the last chunk, and at `no_place`."""
    return jnp.pad(array, [(0, TARGETS + 1)] + [(0, 0)] * (array.ndim - 1))


def sweep(sums: Sums, left: Ints, right: Ints, end: Ints, room: int = 0) -> Sweep:
    """The tables of a sweep, with room for more variables.

    Args:
        sums: the targets and products.
        left, right: the place of each factor by its number; the last is the place of no factor.
        end: the operand that finishes each target (`finish`); the last leaves a target as it is.
        room: the number of variables for which the tables have room.
    """
    size = len(sums.level)
    order, _ = places(sums, size)
    counts = np.bincount(sums.target, minlength=size)
    begin = (np.cumsum(counts) - counts)[order]
    count = counts[order]
    by_target = np.argsort(sums.target, kind="stable").astype(np.int32)
    levels = int(sums.level.max(initial=-1)) + 1
    first = np.searchsorted(sums.level[order], np.arange(levels + 1))
    # Of each chunk the first place, the first product of a target, and the end of the round's
    # targets: they are the first of a level, since the numbers of products fall.
    chunks = [np.zeros((3, 0), int)]
    rounds, ends, end_base = [0], [0], list[int]()
    for low, high in zip(first[:-1].tolist(), first[1:].tolist(), strict=True):
        rounds.append(rounds[-1])
        for shift in range(0, int(count[low]), _TERMS):
            stop = low + int(np.count_nonzero(count[low:high] > shift))
            base = np.arange(low, stop, TARGETS)
            chunks.append(np.stack([base, np.full_like(base, shift), np.full_like(base, stop)]))
            rounds[-1] += len(base)
        end_base += range(low, high, TARGETS)
        ends.append(len(end_base))
    bases, shifts, stops = np.concatenate(chunks, axis=1)
    end_place = np.array(end_base, int)[:, None] + np.arange(TARGETS)
    inside = end_place < np.repeat(first[1:], np.diff(ends))[:, None]
    ending = order[np.minimum(end_place, size - 1)]
    # With room for 16 chunks of products and 4 of targets a variable.
    width = padded_table_size(len(bases), 16 * room)
    finished = padded_table_size(len(end_base), 4 * room)
    tables = [np.full((width, TARGETS, _TERMS), at[-1], np.int32) for at in (left, right)]
    flips = None if sums.flip is None else np.zeros((width, TARGETS, _TERMS), bool)
    for part in range(0, len(bases), _PART):
        chunk = slice(part, min(part + _PART, len(bases)))
        place = bases[chunk, None] + np.arange(TARGETS)  # (chunks, T)
        clipped = np.minimum(place, size - 1)[..., None]
        term = shifts[chunk, None, None] + np.arange(_TERMS)  # (chunks, 1, K)
        exists = (place < stops[chunk, None])[..., None] & (term < count[clipped])
        product = by_target[np.where(exists, begin[clipped] + term, 0)]  # (chunks, T, K)
        for table, factor, at in zip(tables, (sums.left, sums.right), (left, right), strict=True):
            table[chunk] = at[np.where(exists, factor[product], -1)]
        if flips is not None and sums.flip is not None:
            flips[chunk] = sums.flip[product]
    lefts, rights = map(index_table, tables)
    return Sweep(
        index_table(np.array(levels)),
        level_table(rounds, room),
        index_table(bases, width),
        lefts,
        rights,
        level_table(ends, room),
        index_table(np.array(end_base, int), finished),
        index_table(end[np.where(inside, ending, -1)], finished, int(end[-1])),
        None if flips is None else index_table(flips),
    )


def subtract_products(
    tables: Sweep,
    level: jax.Array,
    target: jax.Array,
    left: jax.Array | None,
    right: jax.Array | None,
    product: _Product,
) -> jax.Array:
    """The targets (M, …) after the rounds of a level; a factor of None is a target itself."""
    if not len(tables.base):  # no measurement joins two variables
        return target

    def chunk(c: jax.Array, target: jax.Array) -> jax.Array:
        a = (target if left is None else left)[tables.left[c]]
        b = (target if right is None else right)[tables.right[c]]
        if tables.flip is not None:
            a = jnp.where(tables.flip[c][..., None, None, None], jnp.swapaxes(a, 2, 3), a)
        block = jax.lax.dynamic_slice_in_dim(target, tables.base[c], TARGETS)
        for k in range(_TERMS):
            block = block - product(a[:, k], b[:, k])
        return jax.lax.dynamic_update_slice_in_dim(target, block, tables.base[c], 0)

    subtracted: jax.Array = jax.lax.fori_loop(
        tables.rounds[level], tables.rounds[level + 1], chunk, target
    )
    return subtracted


def finish(
    tables: Sweep, level: jax.Array, target: jax.Array, by: jax.Array, product: _Product
) -> jax.Array:
    """The targets (M, …) after each of a level is replaced by its product with an operand of
    `by`."""
    if not len(tables.end_base):
        return target

    def chunk(c: jax.Array, target: jax.Array) -> jax.Array:
        block = jax.lax.dynamic_slice_in_dim(target, tables.end_base[c], TARGETS)
        block = product(block, by[tables.end[c]])
        return jax.lax.dynamic_update_slice_in_dim(target, block, tables.end_base[c], 0)

    finished: jax.Array = jax.lax.fori_loop(
        tables.ends[level], tables.ends[level + 1], chunk, target
    )
    return finished


_SUMMED = 4
"""Rows that a stage sums at once."""
_LEAST_STAGES = 2
"""The least number of stages, which up to sixteen rows of a target need: with fewer a graph would
have another program."""
_STAGES_WITH_ROOM = 4
"""The least number of stages with room, enough for 256 rows of a target."""

Stages = tuple[Int[Array, "_ terms"], ...]


def stages(target: Int[np.ndarray, "rows"], size: int, room: int = 0) -> Stages:
    """The tables that sum rows into `size` targets; a target of -1 drops its row.

    Each stage sums up to four rows of a target, and gives its sums in the order of the targets,
    until each target has one. With room each stage has at least so many sums.
    """
    used = np.flatnonzero(target >= 0)
    numbers = used[np.argsort(target[used], kind="stable")]
    absent, owner, tables = len(target), target[numbers], list[Array]()
    while True:
        counts = np.bincount(owner, minlength=size)
        last = counts.max(initial=0) <= _SUMMED
        groups = np.ones(size, int) if last else -(-counts // _SUMMED)
        begin, group_begin = np.cumsum(counts) - counts, np.cumsum(groups) - groups
        sums = np.full((groups.sum(), _SUMMED), absent, np.int32)
        rank = np.arange(len(owner)) - begin[owner]  # of a row among those of its target
        sums[group_begin[owner] + rank // _SUMMED, rank % _SUMMED] = numbers
        last_stage = last and len(tables) + 1 >= (_STAGES_WITH_ROOM if room else _LEAST_STAGES)
        rows = len(sums) if last_stage else padded_size(max(len(sums), room))
        tables.append(index_table(sums, rows, absent))
        if last_stage:
            return tuple(tables)
        owner = np.repeat(np.arange(size), groups)
        numbers, absent = np.arange(len(owner)), rows


def sum_rows(stages: Stages, rows: Float[Array, "rows *rest"]) -> Float[Array, "size *rest"]:
    """The sums of the rows of each target; zero where it has none."""
    for sums in stages:
        terms = rows.at[sums].get(mode="fill", fill_value=0)
        rows = terms[:, 0] + terms[:, 1] + (terms[:, 2] + terms[:, 3])
    return rows
