"""The best of all poses of a window: correlative scan matching, exact on its lattice.

By branch and bound: blocks of shifts are bounded, divided and left out.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxslam.core._record import field, record, static
from jaxslam.core.validation import at_least, in_range, not_negative, or_none, positive
from jaxslam.laser.grids._distance import near_distances
from jaxslam.laser.grids._grid import Field, Grid, interpolate, to_cells
from jaxslam.laser.matching._field import field_cost
from jaxslam.laser.matching._matcher import Match, Matcher
from jaxslam.laser.matching._outcome import Limits, Pairs, SearchEnd, length_of, make_match
from jaxslam.laser.matching._point_sets import Points, Prior, prior_cost
from jaxslam.laser.matching._surfaces import surface, surface_information
from jaxslam.math import se2
from jaxslam.math._arrays import Number, in_dtype
from jaxslam.math.angles import wrap

_CHUNK = 16
"""Blocks that are divided in a step; chosen for speed on processors."""


class _Nodes(NamedTuple):
    """Blocks of 2^level × 2^level shifts at a heading each."""

    level: Int[Array, "n"]
    turn: Int[Array, "n"]
    """index of the heading"""
    shift: Int[Array, "n 2"]
    """(rows, columns) of the lower left shift of the block"""


class _Best(NamedTuple):
    """The best pose so far."""

    value: Float[Array, ""]
    """its score; -inf without a pose"""
    turn: Int[Array, ""]
    shift: Int[Array, "2"]
    divided: Int[Array, ""]
    """number of blocks that were divided"""


def _best_shift(
    bound_of: Callable[[_Nodes], Float[Array, "n"]],
    roots: _Nodes,
    bounds: Float[Array, "n"],
    levels: int,
    shifts: int,
    *,
    above: Array | float = -jnp.inf,
    counts: Callable[[_Nodes], Bool[Array, "n"]] | None = None,
    first: bool = False,
) -> _Best:
    """The best shift of all blocks, by depth first search with the best bound ahead.

    A block whose bound is not above the best value so far is skipped; others are divided into four
    (Hess et al. 2016, "Real-time loop closure in 2D LIDAR SLAM", ICRA).

    | top `_CHUNK` blocks of the stack | the search |
    |---|---|
    | none | ends |
    | roots, all bounds at most the best value | ends: roots are sorted, those below are no better |
    | any other | divides the blocks with a better bound, and drops the others |

    Args:
        bound_of: an upper bound of the values in each block; at level 0 the value.
        roots, bounds: blocks of the same level, and their bounds.
        levels: divisions from a root to a single shift, at least 1.
        shifts: largest shift of the window [cells].
        above: only poses of a greater value count.
        counts: the mask of poses that count, of nodes at level 0; default all.
        first: end at the first pose that counts.
    """
    order = jnp.argsort(bounds)
    count = len(bounds)
    # Children lie above their parents, so the blocks of a level are divided before the level gets
    # others: at most 4 children of each of `_CHUNK` blocks at a time.
    room = 4 * _CHUNK * levels
    value = jnp.concatenate([bounds[order], jnp.zeros(room, bounds.dtype)])
    stack = _Nodes(
        *(
            jnp.concatenate([part[order], jnp.zeros((room, *part.shape[1:]), part.dtype)])
            for part in roots
        )
    )
    corner = jnp.asarray(np.array([[0, 0], [0, 1], [1, 0], [1, 1]], np.int32))

    def goes_on(state: tuple[Array, _Nodes, Array, _Best]) -> Array:
        size, _, value, best = state
        # With `count` blocks or fewer only roots are left, the best of them on top.
        rest_is_worse = (size <= count) & (value[jnp.maximum(size - 1, 0)] <= best.value)
        is_open = (size > 0) & ~rest_is_worse
        return jnp.asarray(is_open & (best.value <= above) if first else is_open)

    def step(state: tuple[Array, _Nodes, Array, _Best]) -> tuple[Array, _Nodes, Array, _Best]:
        size, stack, value, best = state
        # Take the top of the stack; places below its bottom hold no block.
        place = size - 1 - jnp.arange(_CHUNK, dtype=size.dtype)
        index = jnp.maximum(place, 0)
        live = (place >= 0) & (value[index] > best.value)

        # Divide each block into four, and bound these.
        parent = jax.tree.map(lambda part: jnp.repeat(part[index], 4, axis=0), stack)
        level = parent.level - 1
        shift = parent.shift + (1 << level)[:, None] * jnp.tile(corner, (_CHUNK, 1))
        child = _Nodes(level, parent.turn, shift)
        bound = bound_of(child)
        in_window = jnp.repeat(live, 4) & jnp.all(shift <= shifts, axis=1)
        good = in_window & (bound > best.value)

        # Single shifts may be the best.
        leaf = level == 0
        score = jnp.where(good & leaf, bound, -jnp.inf)
        if counts is not None:
            score = jnp.where(counts(child), score, -jnp.inf)
        top = jnp.argmax(score)
        better = score[top] > best.value
        best = _Best(
            jnp.where(better, score[top], best.value),
            jnp.where(better, child.turn[top], best.turn),
            jnp.where(better, shift[top], best.shift),
            best.divided + live.sum(dtype=jnp.int32),
        )

        # Push the others: the shallow ones lowest, and of a level the best bound on top. What is
        # not pushed follows, above the new size, where it is not read.
        pushed = good & ~leaf & (bound > best.value)
        rank = jnp.lexsort((bound, -level, ~pushed))
        base = size - jnp.minimum(size, _CHUNK)

        def push(onto: Array, children: Array) -> Array:
            begin = (base, *[jnp.zeros_like(base)] * (onto.ndim - 1))
            return jax.lax.dynamic_update_slice(onto, children[rank], begin)

        stack = jax.tree.map(push, stack, child)
        return base + pushed.sum(dtype=jnp.int32), stack, push(value, bound), best

    zero = jnp.zeros((), jnp.int32)
    nothing = _Best(jnp.asarray(above, bounds.dtype), zero, jnp.zeros(2, jnp.int32), zero)
    size = jnp.asarray(count, jnp.int32)
    *_, best = jax.lax.while_loop(goes_on, step, (size, stack, value, nothing))
    return best


class Scores(NamedTuple):
    """The score of a point by its cell, with `block` cells of 0 around the map."""

    table: Float[Array, "L H W"]
    """at level 0 exp(-d²/2σ²), d the distance to the nearest occupied cell, 0 beyond `_REACH` σ; at
    level l, the largest of the 2^l × 2^l cells with this cell at the lower left"""
    field: Field
    """d [m], of the map alone, up to `_REACH` σ"""


_REACH = 4.0
"""Distance in σ beyond which a point scores 0, where exp(-d²/2σ²) is below 3.4e-4."""


class _Lattice(NamedTuple):
    """The poses of a window, and the scores of the points of a scan at them."""

    start: Float[Array, "3"]
    turns: Float[Array, "H"]
    """headings [rad]"""
    axes: Float[Array, "2 2"]
    """[m] the shift by a row, and by a column, one a column"""
    cells: Int[Array, "H N 2"]
    """(row, column) of each point in the table, at the start with each heading"""
    table: Float[Array, "L H W"]
    """`Scores.table`"""
    valid: Bool[Array, "N"]
    """mask of the points"""
    total: Float[Array, ""]
    """their number, at least 1"""
    sigma: float
    """[m]"""
    prior: Prior | None

    def pose(self, at: _Best) -> Float[Array, "3"]:
        """The pose of a heading and a shift."""
        position = self.start[:2] + self.axes @ at.shift.astype(self.axes.dtype)
        return jnp.concatenate([position, wrap(self.turns[at.turn])[None]])

    def mean_score(self, nodes: _Nodes) -> Float[Array, "n"]:
        """The mean score of the points, at most, within each block."""
        _, height, width = self.table.shape
        cell = self.cells[nodes.turn] + nodes.shift[:, None, :]
        row = jnp.clip(cell[..., 0], 0, height - 1)
        column = jnp.clip(cell[..., 1], 0, width - 1)
        # A flat index into (level, row, column): one gather.
        flat = (nodes.level[:, None] * height + row) * width + column
        score = self.table.reshape(-1)[flat]
        return jnp.where(self.valid, score, 0.0).sum(axis=1) / self.total

    def prior_share(self, nodes: _Nodes) -> Float[Array, "n"]:
        """The score eᵀ Λ e/(2 σ² n) that a prior takes, at least, within each block.

        At its middle √(eᵀ Λ e) is exact; at a corner, u from there, it is less by √(uᵀ Λ u) at
        most.
        """
        prior, dtype = self.prior, self.start.dtype
        if prior is None:
            return jnp.zeros(len(nodes.turn), dtype)
        half = 0.5 * ((1 << nodes.level) - 1).astype(dtype)
        middle = nodes.shift.astype(dtype) + half[:, None]
        position = middle @ self.axes.T + self.start[None, :2]
        pose = jnp.concatenate([position, self.turns[nodes.turn][:, None]], axis=1)
        e = jax.vmap(prior.error)(pose)
        square = jnp.maximum(((e @ prior.information) * e).sum(axis=1), 0.0)
        # Of a block of half side 1; those of the opposite corners are the same.
        u = jnp.asarray([[1.0, 1.0], [1.0, -1.0]], dtype) @ self.axes.T
        far = jnp.maximum(((u @ prior.information[:2, :2]) * u).sum(axis=1).max(), 0.0)
        least = jnp.maximum(jnp.sqrt(square) - half * jnp.sqrt(far), 0.0)
        least = jnp.where(nodes.level == 0, square, least**2)
        return least / (2 * self.sigma**2 * self.total)

    def bound(self, nodes: _Nodes) -> Float[Array, "n"]:
        """An upper bound of the score within each block; of a single shift the score."""
        return self.mean_score(nodes) - self.prior_share(nodes)


def _power_of_two(value: int) -> int:
    """The check of 2, 4, 8, …"""
    if at_least(2)(value) & (value - 1):
        raise ValueError(f"expected 2, 4, 8, …, got {value}")
    return value


@record
class Correlative(Matcher):
    """The pose of a window with the highest mean score of the points, exp(-d²/2σ²) each.

    The window holds the headings start ± turn_window in steps of `turn` [rad], and shifts of the
    start by whole cells of the reference's grid up to ± window [m] along its axes. A point scores
    by the cell that it falls into, 0 off the map and beyond 4 σ. A prior takes eᵀ Λ e/(2 σ² n) from
    the mean score of n points, as near a wall exp(-d²/2σ²) is 1 - d²/2σ².

    The maximum is exact on this lattice: blocks of shifts are scored by the largest score of any
    cell that a point meets within the block, less what the prior takes at least there: an upper
    bound. Those that may hold the best are divided, down to single shifts (`_best_shift`).

    Olson 2009, "Real-time correlative scan matching", ICRA; bounds over sliding blocks as Hess et
    al. 2016, "Real-time loop closure in 2D LIDAR SLAM", ICRA. The pose is one of the lattice:
    `FieldMatcher` from there refines it. The reference is a `Grid`. A point takes part within 3 σ
    of an occupied cell; the lines that tell what the scan determines, and when a match is refused,
    are those of `IcpSettings()`.

    What fixes the number of shifts, headings and cells is static: another one is another program.

    Raises ValueError on a number out of range.
    """

    _: dataclasses.KW_ONLY
    window: float = static(default=0.3, check=not_negative)
    """[m] to either side"""
    turn_window: float = static(default=float(np.deg2rad(20.0)), check=not_negative)
    """[rad] to either side"""
    turn: float = static(default=float(np.deg2rad(0.5)), check=positive)
    """[rad] between headings"""
    cell: float = static(default=0.05, check=positive)
    """resolution of the grids [m], which fixes the number of shifts; that of another grid counts in
    place of it, with as many cells"""
    sigma: float = static(default=0.05, check=positive)
    """[m] of the score"""
    block: int = static(default=4, check=_power_of_two)
    """shifts along each axis that are bounded together at first: 2, 4, 8, …"""
    ambiguous: Number | None = field(default=0.95, check=or_none(in_range(0.0, 1.0, open=True)))
    """the status is AMBIGUOUS where a pose more than `apart` away from the best scores above this
    share of it; None does not look for one"""
    apart: Number = field(default=0.3, check=positive)
    """[m], angles times the RMS range"""
    of_grid = True

    @property
    def _shifts(self) -> int:
        """The largest shift along an axis [cells]."""
        return int(np.ceil(self.window / self.cell - 1e-9))

    @property
    def _levels(self) -> int:
        """Divisions of a block."""
        return self.block.bit_length() - 1

    def prepare(self, reference: Grid) -> Scores:
        sigma, block = self.sigma, self.block
        reach = int(np.ceil(_REACH * sigma / self.cell))
        squared = near_distances(reference.log_odds > 0, reach)
        dtype = reference.log_odds.dtype
        d = jnp.asarray(reference.resolution, dtype) * jnp.sqrt(squared.astype(dtype))
        score = jnp.where(squared <= reach**2, jnp.exp(-0.5 * (d / sigma) ** 2), 0.0)
        tables = [jnp.pad(score, block)]
        # The largest of 2 × 2 cells that lie 2^level apart, each the largest of as many cells.
        for level in range(self._levels):
            right = jnp.maximum(tables[-1], jnp.roll(tables[-1], -(2**level), 1))
            tables.append(jnp.maximum(right, jnp.roll(right, -(2**level), 0)))
        frame = jnp.asarray(reference.origin), jnp.asarray(reference.resolution)
        return Scores(jnp.stack(tables), Field(d, *frame))

    def match(
        self,
        prepared: Scores,
        points: Points,
        start: Float[Array, "3"],
        prior: Prior | None = None,
    ) -> Match:
        sigma, shifts, levels, dtype = self.sigma, self._shifts, self._levels, start.dtype
        ambiguous, apart = in_dtype((self.ambiguous, self.apart), dtype)
        field = prepared.field

        # The lattice.
        steps = int(np.ceil(self.turn_window / self.turn - 1e-9))
        turns = start[2] + jnp.asarray(self.turn * np.arange(-steps, steps + 1), dtype)

        def cells_at(turn: Array) -> Int[Array, "N 2"]:
            moved = points.position @ se2.rotation(turn).T + start[None, :2]
            cell = to_cells(field.origin, field.resolution, moved)[:, ::-1]
            return jnp.floor(cell).astype(jnp.int32) + self.block  # of the table, with its border

        lattice = _Lattice(
            start=start,
            turns=turns,
            axes=field.resolution * se2.rotation(field.origin[2])[:, ::-1],
            cells=jax.vmap(cells_at)(turns),
            table=prepared.table,
            valid=points.valid,
            total=jnp.maximum(points.valid.sum(dtype=dtype), 1),
            sigma=sigma,
            prior=prior,
        )

        # Blocks that cover the window, (heading, corner), and then a list of them.
        axis = np.arange(-shifts, shifts + 1, self.block, dtype=np.int32)
        corners = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
        size = len(turns), len(corners)
        blocks = _Nodes(
            level=jnp.full(size, levels, jnp.int32),
            turn=jnp.broadcast_to(jnp.arange(len(turns), dtype=jnp.int32)[:, None], size),
            shift=jnp.broadcast_to(jnp.asarray(corners), (*size, 2)),
        )
        # One heading after another: the scores of all at once would need N times the memory.
        bounds = jax.lax.map(lattice.bound, blocks).reshape(-1)
        roots = jax.tree.map(lambda part: part.reshape(-1, *part.shape[2:]), blocks)

        # The best pose, and whether one apart from it is nearly as good.
        search = partial(_best_shift, lattice.bound, roots, bounds, levels, shifts)
        best = search()
        is_ambiguous: Array | bool = False
        if ambiguous is not None:
            by_turn = length_of(points) * float(self.turn)

            def is_apart(nodes: _Nodes) -> Bool[Array, "n"]:
                way = field.resolution * (nodes.shift - best.shift[None]).astype(dtype)
                turned = jnp.abs(nodes.turn - best.turn).astype(dtype)
                return jnp.hypot(*way.T) + by_turn * turned > apart

            limit = ambiguous * best.value
            is_ambiguous = search(above=limit, counts=is_apart, first=True).value > limit

        pose = lattice.pose(best)
        moved = points.position @ se2.rotation(pose[2]).T + pose[None, :2]
        residual = interpolate(field, moved)
        weight = (points.valid & (residual < 3 * sigma)).astype(residual.dtype)
        leaf = _Nodes(jnp.zeros(1, jnp.int32), best.turn[None], best.shift[None])
        return make_match(
            points,
            start,
            prior,
            SearchEnd(pose, best.divided, True, is_ambiguous),
            Pairs(residual, weight),
            lattice.mean_score(leaf)[0],
            surface_information(surface(points), pose, weight),
            Limits(),
        )

    def cost(
        self, prepared: Scores, points: Points, pose: Float[Array, "3"], match: Match
    ) -> Float[Array, ""]:
        points_cost = field_cost(prepared.field, points, pose, match.weight)
        return points_cost + prior_cost(match.prior, pose)
