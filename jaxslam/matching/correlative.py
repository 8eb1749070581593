"""The best of all poses of a window: correlative scan matching, exact on its lattice."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxslam.grids.distance import near_distances
from jaxslam.grids.grid import Field, Grid, to_cells
from jaxslam.grids.interpolation import interpolate
from jaxslam.matching.branch_and_bound import Nodes, best_shift
from jaxslam.matching.field import field_cost
from jaxslam.matching.matcher import Match, Matcher
from jaxslam.matching.outcome import Limits, concluded, length_of
from jaxslam.matching.points import Points
from jaxslam.matching.prior import Prior, prior_cost
from jaxslam.matching.surface import surface, surface_information
from jaxslam.math import se2
from jaxslam.math.angles import wrap


class Scores(NamedTuple):
    """What a point scores by its cell, with `block` cells of 0 around the map."""

    table: Float[Array, "L H W"]
    """first exp(-d²/2σ²), d the distance to the nearest occupied cell, 0 beyond `REACH` σ; then, at
    level l, the largest of the 2^l × 2^l cells of which this is the lower left one"""
    field: Field
    """d [m], of the map alone, up to `REACH` σ"""


REACH = 4.0
"""Distance in σ beyond which a point scores 0, where exp(-d²/2σ²) is below 3.4e-4."""


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
    span: int = 5,
    gap: float = 0.5,
    fewest: int = 10,
    least_score: float = 0.5,
    least_condition: float = 0.01,
) -> Matcher:
    """The pose of a window with the highest mean score of the points, exp(-d²/2σ²) each.

    The window holds the headings start ± turn_window in steps of `turn` [rad], and shifts of the
    start by whole cells of the reference's grid up to ± window [m] along its axes. A point scores
    by the cell that it falls into, 0 off the map and beyond 4 σ. A prior takes eᵀ Λ e/(2 σ² n) from
    the mean score of n points, as near a wall exp(-d²/2σ²) is 1 - d²/2σ².

    The maximum is exact on this lattice: blocks of shifts are scored by the largest score of any
    cell that a point meets within the block, less what the prior takes at least there: an upper
    bound. Those that may hold the best are divided, down to single shifts (`best_shift`).

    Olson 2009, "Real-time correlative scan matching", ICRA; bounds over sliding blocks as Hess et
    al. 2016, "Real-time loop closure in 2D LIDAR SLAM", ICRA. The pose is one of the lattice:
    `field` from there refines it. The reference is a `Grid`.

    Args:
        cell: resolution of the grids [m], which fixes the number of shifts; that of another grid
            counts in place of it, with as many cells.
        sigma: [m] of the score.
        block: shifts along each axis that are bounded together at first: 2, 4, 8, …
        ambiguous: the status is AMBIGUOUS where a pose more than `apart` [m] away from the best
            (angles times the RMS range) scores above this share of it; 1 does not look for one.
        span, gap: of the lines through the points of the scan, which tell what it determines, as
            in `IcpSettings`.
        fewest, least_score, least_condition: as in `IcpSettings`; a point takes part within 3 σ of
            an occupied cell.
    Raises:
        ValueError: a number out of range.
    """
    if not (window >= 0 and turn_window >= 0 and turn > 0 and cell > 0 and sigma > 0):
        raise ValueError(
            "correlative: expected windows not below 0, and turn, cell and sigma above 0, got "
            f"{window}, {turn_window}, {turn}, {cell}, {sigma}"
        )
    if block < 2 or block & (block - 1) or not 0 < ambiguous <= 1 or not apart > 0:
        raise ValueError(
            "correlative: expected block 2, 4, 8, …, ambiguous in (0, 1] and apart above 0, got "
            f"{block}, {ambiguous}, {apart}"
        )
    shifts = int(np.ceil(window / cell - 1e-9))
    steps = int(np.ceil(turn_window / turn - 1e-9))
    levels = block.bit_length() - 1
    reach = int(np.ceil(REACH * sigma / cell))
    offsets = turn * np.arange(-steps, steps + 1)
    limits = Limits(fewest, least_score, least_condition)
    corners = _square(np.arange(-shifts, shifts + 1, block))

    def prepare(grid: Grid) -> Scores:
        squared = near_distances(grid.log_odds > 0, reach)
        dtype = grid.log_odds.dtype
        d = jnp.asarray(grid.resolution, dtype) * jnp.sqrt(squared.astype(dtype))
        score = jnp.where(squared <= reach**2, jnp.exp(-0.5 * (d / sigma) ** 2), 0.0)
        tables = [jnp.pad(score, block)]
        for level in range(levels):
            right = jnp.maximum(tables[-1], jnp.roll(tables[-1], -(2**level), 1))
            tables.append(jnp.maximum(right, jnp.roll(right, -(2**level), 0)))
        frame = jnp.asarray(grid.origin), jnp.asarray(grid.resolution)
        return Scores(jnp.stack(tables), Field(d, *frame))

    def match(of: Scores, points: Points, start: Array, prior: Prior | None = None) -> Match:
        turns = start[2] + jnp.asarray(offsets, start.dtype)
        count = jnp.maximum(points.valid.sum(), 1)
        _, height, width = of.table.shape
        cell_size = of.field.resolution
        axes = cell_size * se2.rotation(of.field.origin[2])[:, ::-1]  # of a row, of a column

        def cells(turn: Array) -> Int[Array, "N 2"]:
            """The cells (row, column) of the points at the start, turned so."""
            moved = points.position @ se2.rotation(turn).T + start[None, :2]
            at = to_cells(of.field.origin, of.field.resolution, moved)[:, ::-1]
            return jnp.floor(at).astype(jnp.int32) + block

        here = jax.vmap(cells)(turns)

        def seen(nodes: Nodes) -> Float[Array, "n"]:
            """The mean score of the points."""
            at = here[nodes.turn] + nodes.shift[:, None, :]
            row, column = jnp.clip(at[..., 0], 0, height - 1), jnp.clip(at[..., 1], 0, width - 1)
            flat = (nodes.level[:, None] * height + row) * width + column
            return jnp.where(points.valid, of.table.reshape(-1)[flat], 0.0).sum(axis=1) / count

        def taken(nodes: Nodes) -> Float[Array, "n"]:
            """The score that a prior takes at least within each block.

            At the middle it is √(eᵀ Λ e); at a corner it is less by √(uᵀ Λ u) at most."""
            if prior is None:
                return jnp.zeros(len(nodes.turn), start.dtype)
            half = 0.5 * ((1 << nodes.level) - 1).astype(start.dtype)
            middle = (nodes.shift + half[:, None]) @ axes.T + start[None, :2]
            pose = jnp.concatenate([middle, turns[nodes.turn][:, None]], axis=1)
            e = jax.vmap(prior.error)(pose)
            square = jnp.maximum(((e @ prior.information) * e).sum(axis=1), 0.0)
            corner = jnp.asarray([[1.0, 1.0], [1.0, -1.0]], start.dtype) @ axes.T
            far = ((corner @ prior.information[:2, :2]) * corner).sum(axis=1).max()
            least = jnp.maximum(jnp.sqrt(square) - half * jnp.sqrt(jnp.maximum(far, 0.0)), 0.0)
            least = jnp.where(nodes.level == 0, square, least**2)
            return least / (2 * sigma**2 * count)

        def bound_of(nodes: Nodes) -> Float[Array, "n"]:
            return seen(nodes) - taken(nodes)

        def roots_of(turn: Array) -> Nodes:
            full = jnp.full(len(corners), levels, jnp.int32)
            return Nodes(full, jnp.broadcast_to(turn, full.shape), jnp.asarray(corners))

        numbers = jnp.arange(len(offsets), dtype=jnp.int32)
        bounds = jax.lax.map(lambda turn: bound_of(roots_of(turn)), numbers).reshape(-1)
        roots = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), jax.vmap(roots_of)(numbers))
        best = best_shift(bound_of, roots, bounds, levels, shifts)
        elsewhere: Array | bool = False
        if ambiguous < 1:
            by_turn = length_of(points) * turn

            def far(nodes: Nodes) -> Array:
                way = cell_size * (nodes.shift - best.shift[None])
                return jnp.hypot(*way.T) + by_turn * jnp.abs(nodes.turn - best.turn) > apart

            limit = ambiguous * best.value
            other = best_shift(
                bound_of, roots, bounds, levels, shifts, above=limit, counts=far, first=True
            )
            elsewhere = other.value > limit
        pose = jnp.concatenate([start[:2] + axes @ best.shift, wrap(turns[best.turn])[None]])
        moved = points.position @ se2.rotation(pose[2]).T + pose[None, :2]
        residual = interpolate(of.field, moved)
        weight = (points.valid & (residual < 3 * sigma)).astype(residual.dtype)
        only = Nodes(jnp.zeros(1, jnp.int32), best.turn[None], best.shift[None])
        return concluded(
            start,
            pose,
            points,
            residual=residual,
            weight=weight,
            pair=jnp.zeros(weight.shape, jnp.int32),
            information=surface_information(surface(points, span, gap), pose, weight),
            spread=sigma,
            iterations=best.divided,
            converged=jnp.ones((), bool),
            limits=limits,
            ambiguous=elsewhere,
            score=seen(only)[0],
            prior=prior,
        )

    def cost(of: Scores, points: Points, pose: Array, found: Match) -> Array:
        return field_cost(of.field, points, pose, found.weight) + prior_cost(found.prior, pose)

    return Matcher("correlative", prepare, match, cost, of_grid=True)


def _square(axis: Int[np.ndarray, "n"]) -> Int[np.ndarray, "n*n 2"]:
    """All pairs of the entries, (n², 2)."""
    return np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2).astype(np.int32)
