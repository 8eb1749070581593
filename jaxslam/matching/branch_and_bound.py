"""The best pose of a lattice, exactly: blocks of shifts that are bounded, divided and left out."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

_CHUNK = 16
"""Blocks that are divided in one step."""


class Nodes(NamedTuple):
    """Blocks of 2^level × 2^level shifts at a heading each."""

    level: Int[Array, "n"]
    turn: Int[Array, "n"]
    """number of the heading"""
    shift: Int[Array, "n 2"]
    """(rows, columns), the lower left one of the block"""


class Best(NamedTuple):
    """The best pose found."""

    value: Float[Array, ""]
    """-inf of none"""
    turn: Int[Array, ""]
    shift: Int[Array, "2"]
    divided: Int[Array, ""]
    """how many blocks were"""


def best_shift(
    bound_of: Callable[[Nodes], Float[Array, "n"]],
    roots: Nodes,
    bounds: Float[Array, "n"],
    levels: int,
    shifts: int,
    *,
    above: Array | float = -jnp.inf,
    counts: Callable[[Nodes], Bool[Array, "n"]] | None = None,
    first: bool = False,
) -> Best:
    """The best shift of all blocks, by depth first search with the best bound ahead.

    A block whose bound is not above the best value so far is left out; others are divided into four
    (Hess et al. 2016, "Real-time loop closure in 2D LIDAR SLAM", ICRA).

    Args:
        bound_of: an upper bound of the values in each block; at level 0 the value.
        roots, bounds: of one level, `levels` at least 1.
        shifts: those farther than this are outside the window.
        above: only poses of a greater value count.
        counts: which poses count, of nodes at level 0; default all.
        first: whether the first pose that counts will do.
    """
    order = jnp.argsort(bounds)
    count = len(bounds)
    room = 4 * _CHUNK * levels
    # Deeper blocks lie above shallower ones, so that those of a level are divided before any more
    # of it come: at most 4 · chunk of each at a time.
    value = jnp.concatenate([bounds[order], jnp.zeros(room, bounds.dtype)])
    stack = Nodes(
        *(jnp.concatenate([p[order], jnp.zeros((room, *p.shape[1:]), p.dtype)]) for p in roots)
    )
    corner = jnp.asarray(np.array([[0, 0], [0, 1], [1, 0], [1, 1]], np.int32))

    def unfinished(state: tuple[Array, Nodes, Array, Best]) -> Array:
        size, _, value, best = state
        rest_is_worse = (size <= count) & (value[jnp.maximum(size - 1, 0)] <= best.value)
        more = (size > 0) & ~rest_is_worse
        return jnp.asarray(more & (best.value <= above) if first else more)

    def step(state: tuple[Array, Nodes, Array, Best]) -> tuple[Array, Nodes, Array, Best]:
        size, stack, value, best = state
        at = size - 1 - jnp.arange(_CHUNK)
        live = (at >= 0) & (value[jnp.maximum(at, 0)] > best.value)
        parent = jax.tree.map(lambda part: jnp.repeat(part[jnp.maximum(at, 0)], 4, axis=0), stack)
        level = parent.level - 1
        shift = parent.shift + (1 << level)[:, None] * jnp.tile(corner, (_CHUNK, 1))
        child = Nodes(level, parent.turn, shift)
        bound = bound_of(child)
        good = jnp.repeat(live, 4) & jnp.all(shift <= shifts, axis=1) & (bound > best.value)
        leaf = level == 0
        score = jnp.where(good & leaf, bound, -jnp.inf)
        if counts is not None:
            score = jnp.where(counts(child), score, -jnp.inf)
        top = jnp.argmax(score)
        better = score[top] > best.value
        best = Best(
            jnp.where(better, score[top], best.value),
            jnp.where(better, child.turn[top], best.turn),
            jnp.where(better, shift[top], best.shift),
            best.divided + live.sum(dtype=jnp.int32),
        )
        kept = good & ~leaf & (bound > best.value)
        rank = jnp.lexsort((bound, -level, ~kept))
        base = size - jnp.minimum(size, _CHUNK)

        def pushed(onto: Array, these: Array) -> Array:
            begin = (base, *[jnp.zeros_like(base)] * (onto.ndim - 1))
            return jax.lax.dynamic_update_slice(onto, these[rank], begin)

        stack = jax.tree.map(pushed, stack, child)
        return base + kept.sum(dtype=jnp.int32), stack, pushed(value, bound), best

    zero = jnp.zeros((), jnp.int32)
    none = Best(jnp.asarray(above, bounds.dtype), zero, jnp.zeros(2, jnp.int32), zero)
    size = jnp.asarray(count, jnp.int32)
    *_, best = jax.lax.while_loop(unfinished, step, (size, stack, value, none))
    return best
