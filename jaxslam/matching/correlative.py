"""The best of all poses of a window: correlative scan matching, exact on its lattice."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxslam.grids.distance import distance_field
from jaxslam.grids.grid import Field, Grid, to_cells
from jaxslam.matching.field import field_cost, field_residuals
from jaxslam.matching.matcher import Match, Matcher
from jaxslam.matching.outcome import Limits, concluded, information_of, length_of
from jaxslam.matching.points import Points
from jaxslam.math import se2
from jaxslam.math.angles import wrap

_CHUNK = 8
"""Blocks that are looked at in one step."""


class Scores(NamedTuple):
    """What a point scores by its cell, with `block` cells of 0 around the map."""

    fine: Float[Array, "H W"]
    """exp(-d²/2σ²), d the distance to the nearest occupied cell"""
    coarse: Float[Array, "H W"]
    """the largest of the block × block cells of which this is the lower left one"""
    field: Field
    """d [m], of the map alone"""


def correlative(
    *,
    window: float = 0.3,
    turn_window: float = float(np.deg2rad(20.0)),
    turn: float = float(np.deg2rad(0.5)),
    cell: float = 0.05,
    sigma: float = 0.05,
    block: int = 4,
    ambiguous: float = 0.95,
    apart: float = 0.3,
    fewest: int = 10,
    least_score: float = 0.5,
    least_condition: float = 0.01,
) -> Matcher:
    """The pose of a window with the highest mean score of the points, exp(-d²/2σ²) each.

    The window holds the headings start ± turn_window in steps of `turn` [rad], and shifts of the
    start by whole cells of the reference's grid up to ± window [m] along its axes. A point scores
    by the cell that it falls into, 0 off the map. The maximum is exact on this lattice: first all
    headings and blocks of shifts are scored by the largest score of any cell that a point meets
    within the block, an upper bound; then blocks are looked at in the order of their bounds, until
    no bound is above the best score.

    Olson 2009, "Real-time correlative scan matching", ICRA; bounds over sliding blocks as Hess et
    al. 2016, "Real-time loop closure in 2D LIDAR SLAM", ICRA. The pose is one of the lattice:
    `field` from there refines it. The reference is a `Grid`.

    Args:
        cell: resolution of the grids [m], which fixes the number of shifts; that of another grid
            counts in place of it, with as many cells.
        sigma: [m] of the score.
        block: shifts along each axis that are bounded together.
        ambiguous: the status is AMBIGUOUS where the best pose of another block, more than `apart`
            [m] away (angles times the RMS range), scores above this share of the maximum.
        fewest, least_score, least_condition: as in `point_to_line`; a point takes part within 3 σ
            of an occupied cell.
    Raises:
        ValueError: a number out of range.
    """
    if not (window >= 0 and turn_window >= 0 and turn > 0 and cell > 0 and sigma > 0):
        raise ValueError(
            "correlative: expected windows not below 0, and turn, cell and sigma above 0, got "
            f"{window}, {turn_window}, {turn}, {cell}, {sigma}"
        )
    if block < 1 or not 0 < ambiguous <= 1 or not apart > 0:
        raise ValueError(
            "correlative: expected block >= 1, ambiguous in (0, 1] and apart above 0, got "
            f"{block}, {ambiguous}, {apart}"
        )
    shifts = int(np.ceil(window / cell - 1e-9))
    steps = int(np.ceil(turn_window / turn - 1e-9))
    offsets = turn * np.arange(-steps, steps + 1)
    limits = Limits(fewest, least_score, least_condition)
    # The lower left shifts of the blocks, and the shifts within one.
    corners = _square(np.arange(-shifts, shifts + 1, block))
    within = _square(np.arange(block))

    def prepare(grid: Grid) -> Scores:
        field = distance_field(grid)
        fine = jnp.pad(jnp.exp(-0.5 * (field.values / sigma) ** 2), block)
        coarse = jax.lax.reduce_window(
            fine, -jnp.inf, jax.lax.max, (block, block), (1, 1), 2 * [(0, block - 1)]
        )
        return Scores(fine, coarse, field)

    def match(of: Scores, points: Points, start: Array) -> Match:
        turns = start[2] + jnp.asarray(offsets, start.dtype)
        count = jnp.maximum(points.valid.sum(), 1)

        def cells(turn: Array) -> Int[Array, "N 2"]:
            """(row, column) of the points at the start, turned so."""
            moved = points.position @ se2.rotation(turn).T + start[None, :2]
            at = to_cells(of.field.origin, of.field.resolution, moved)[:, ::-1]
            return jnp.floor(at).astype(jnp.int32)

        def mean(table: Array, at: Int[Array, "N 2"], shift: Int[Array, "S 2"]) -> Array:
            """The mean score of the points after each of some shifts."""
            height, width = table.shape
            row = jnp.clip(at[None, :, 0] + shift[:, None, 0] + block, 0, height - 1)
            column = jnp.clip(at[None, :, 1] + shift[:, None, 1] + block, 0, width - 1)
            return jnp.where(points.valid, table[row, column], 0.0).sum(axis=1) / count

        here = jax.vmap(cells)(turns)
        bound = jax.lax.map(lambda at: mean(of.coarse, at, jnp.asarray(corners)), here)
        blocks = bound.size
        chunk = min(_CHUNK, blocks)
        bound, order = jax.lax.top_k(bound.ravel(), blocks)
        room = -blocks % chunk
        bound = jnp.concatenate([bound, jnp.full(room + chunk, -1.0, bound.dtype)])
        order = jnp.concatenate([order, jnp.zeros(room, order.dtype)])

        def look(block_number: Array) -> tuple[Array, Array]:
            """The best score of a block, and its shift."""
            k, corner = jnp.divmod(block_number, len(corners))
            shift = jnp.asarray(corners)[corner][None] + jnp.asarray(within)
            score = mean(of.fine, here[k], shift)
            score = jnp.where(jnp.all(shift <= shifts, axis=1), score, -1.0)
            best = jnp.argmax(score)
            return score[best], shift[best]

        def unfinished(state: Any) -> Array:
            return jnp.asarray(bound[state[0]] > ambiguous * state[1].max())

        def step(state: Any) -> Any:
            next_, score, shift = state
            numbers = jax.lax.dynamic_slice(order, (next_,), (chunk,))
            found, where = jax.vmap(look)(numbers)
            score = jax.lax.dynamic_update_slice(score, found, (next_,))
            shift = jax.lax.dynamic_update_slice(shift, where, (next_, jnp.zeros_like(next_)))
            return next_ + chunk, score, shift

        first = (
            jnp.zeros((), jnp.int32),
            jnp.full(blocks + room, -1.0, bound.dtype),
            jnp.zeros((blocks + room, 2), jnp.int32),
        )
        looked, score, shift = jax.lax.while_loop(unfinished, step, first)
        best = jnp.argmax(score)
        turned = order // len(corners)
        cell_size = of.field.resolution
        away = jnp.hypot(*(cell_size * (shift - shift[best][None])).T)
        away = away + length_of(points) * turn * jnp.abs(turned - turned[best])
        second = jnp.where(away > apart, score, -1.0).max()
        moved = se2.rotation(of.field.origin[2]) @ (cell_size * shift[best][::-1])
        pose = jnp.concatenate([start[:2] + moved, wrap(turns[turned[best]])[None]])
        residual, jacobian = field_residuals(of.field, points, pose)
        weight = (points.valid & (residual < 3 * sigma)).astype(residual.dtype)
        return concluded(
            start,
            pose,
            points,
            residual=residual,
            weight=weight,
            pair=jnp.zeros(weight.shape, jnp.int32),
            information=information_of(jacobian, weight),
            spread=sigma,
            iterations=looked,
            converged=jnp.ones((), bool),
            limits=limits,
            ambiguous=(second > ambiguous * score[best]) & (ambiguous < 1),
            score=score[best],
        )

    def cost(of: Scores, points: Points, pose: Array, found: Match) -> Array:
        return field_cost(of.field, points, pose, found.weight)

    return Matcher("correlative", prepare, match, cost, of_grid=True)


def _square(axis: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """All pairs of the entries, (n², 2)."""
    return np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2).astype(np.int32)
