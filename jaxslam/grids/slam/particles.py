"""Particles with an occupancy grid each, and copies of them where they are resampled."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, Int

from jaxslam.core.numbers import shape_told
from jaxslam.grids.grid import Grid
from jaxslam.grids.mapping import Counts, occupancy


class GridParticles(NamedTuple):
    """P weighted poses with the counts of a map each."""

    pose: Float[Array, "P 3"]
    log_weight: Float[Array, "P"]
    """Σ exp = 1"""
    best: Int[Array, ""]
    """the most likely particle"""
    hits: Int[Array, "P H W"]
    misses: Int[Array, "P H W"]
    origin: Float[Array, "3"]
    """of all maps"""
    resolution: Float[Array, ""]
    control: Float[Array, "U"]
    """of the motion that leads to the next scan, which poses do not have yet"""
    pending: Bool[Array, ""]
    """there is such a motion"""
    due: Bool[Array, ""]
    """to be resampled before the next motion"""
    start_cov: Float[Array, "3 3"]
    """of the start while it is not drawn yet, then zero"""
    copied: Int[Array, ""]
    """maps copied by the last resampling, 0 if there was none before this step's motion"""


class MapInfo(NamedTuple):
    """The record `info.extra["maps"]` of `grid_slam`."""

    copied: Int[Array, "*T"]
    """maps overwritten by copies before this step's motion"""
    outside: Int[Array, "*T"]
    """particles off their map, which does not count the scan"""


def best_map(state: GridParticles, *, hit: ArrayLike = 0.7, miss: ArrayLike = 0.4) -> Grid:
    """The map of the most likely particle, as `occupancy` of its counts.

    Its path is one draw; what the other particles hold is not in it. Raises ValueError on the
    states of a batch, of which `jax.vmap(grids.best_map)` makes a map each.
    """
    if not isinstance(state, GridParticles) or np.ndim(state.hits) != 3:
        got = shape_told(state.hits) if isinstance(state, GridParticles) else type(state).__name__
        raise ValueError(
            "best_map: expected the GridParticles of one run, with hits (P, H, W), got "
            f"{got}; a batch takes jax.vmap(grids.best_map)"
        )
    none = jnp.zeros((), jnp.int32)
    frame = state.origin, state.resolution
    counts = Counts(state.hits[state.best], state.misses[state.best], *frame, none, none)
    return occupancy(counts, hit=hit, miss=miss)


def in_place(ancestor: Int[Array, "P"]) -> Int[Array, "P"]:
    """The ancestors, permuted: a particle that has descendants is itself one, in its own place.

    So only the others are overwritten, by copies of those that stay: as many maps are copied as
    particles die.
    """
    size = ancestor.shape[0]
    slot = jnp.arange(size, dtype=ancestor.dtype)
    ordered = jnp.sort(ancestor)
    again = jnp.concatenate([jnp.zeros(1, bool), ordered[1:] == ordered[:-1]])
    spare = ordered[jnp.argsort(~again, stable=True)]  # second and later copies come first
    dead = jnp.zeros(size, bool).at[ancestor].set(True)
    dead = ~dead
    rank = jnp.cumsum(dead) - 1
    return jnp.where(dead, spare[jnp.maximum(rank, 0)], slot)


def copied_rows(tables: tuple[Array, ...], source: Int[Array, "P"]) -> tuple[Array, ...]:
    """Each table (P, …) with row p replaced by row source[p], of ancestors `in_place`.

    One row after the other, and none that stays: a gather would copy all.
    """
    changed = source != jnp.arange(source.shape[0], dtype=source.dtype)
    order = jnp.argsort(~changed, stable=True)

    def one(k: Array, tables: tuple[Array, ...]) -> tuple[Array, ...]:
        into = order[k]
        return tuple(
            jax.lax.dynamic_update_index_in_dim(table, table[source[into]], into, 0)
            for table in tables
        )

    copied: tuple[Array, ...] = jax.lax.fori_loop(0, changed.sum(), one, tables)
    return copied
