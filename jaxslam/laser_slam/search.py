"""One scan against the points of others: correlation over a window, then lines.

Both are programs of fixed shapes in float32, in the frame of the reference.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

CELL = 0.1
"""[m] side of a cell of the tables"""
BLUR = 0.1
"""[m] standard deviation of the score of a point by its distance from the reference"""
PENALTY = 0.01
"""Mean score that a squared distance of one standard deviation from the prior costs."""
POINT = 0.5
"""What a metre from a point of the reference that has no line counts."""
HALF = 160
"""cells from the middle of a table to its border"""


class Reference(NamedTuple):
    """R points that a scan is matched with, with the directions of their walls."""

    points: Float[Array, "R 2"]
    normals: Float[Array, "R 2"]
    """(0, 0) where there is no line"""
    valid: Bool[Array, "R"]


class Window(NamedTuple):
    """The lattice of a search: static numbers."""

    turns: int
    """steps of the angle to either side"""
    turn: float
    """[rad] of a step"""
    blocks: int
    """steps of 2^level cells to either side"""
    level: int
    """of the first tables"""
    kept: int
    """blocks that are looked into, of each level"""

    @property
    def distance(self) -> float:
        """[m] to either side"""
        return float(self.blocks * 2**self.level * CELL)


class Found(NamedTuple):
    """The best pose of a lattice."""

    pose: Float[Array, "3"]
    score: Float[Array, ""]
    """mean over the points of exp(-d²/2σ²), d the distance from the reference"""
    other: Float[Array, ""]
    """the best score half a metre or ten degrees away from the pose, of those looked into"""


class Fitted(NamedTuple):
    """A pose by the lines of the reference, and a prior."""

    pose: Float[Array, "3"]
    information: Float[Array, "3 3"]
    """Σ w J Jᵀ by the coordinates (x, y, θ), without the prior: Fisher's times σ²"""
    residual: Float[Array, ""]
    """[m] root mean square distance of the points from their lines, weighted"""
    inliers: Float[Array, ""]
    """share of the points within 0.1 m of a line, or 0.15 m of a point without one"""


def tables(reference: Reference, levels: int) -> tuple[Float[Array, "C C"], ...]:
    """Scores of cells; table l has the largest of the 2^l × 2^l cells from each on."""
    size = 2 * HALF
    cell = jnp.floor(reference.points / CELL).astype(jnp.int32) + HALF
    inside = reference.valid & (cell > 1).all(axis=1) & (cell < size - 2).all(axis=1)
    at = jnp.where(inside, cell[:, 1] * size + cell[:, 0], size * size)
    score = jnp.zeros(size * size, jnp.float32).at[at].max(1.0, mode="drop").reshape(size, size)
    reach = 3
    for axis in (0, 1):
        spread = score
        for k in range(1, reach + 1):
            weight = jnp.exp(-0.5 * jnp.float32(k * CELL / BLUR) ** 2)
            for side in (k, -k):
                spread = jnp.maximum(spread, weight * jnp.roll(score, side, axis))
        score = spread
    border = jnp.zeros((size, size), bool).at[1:-1, 1:-1].set(True)
    out = [jnp.where(border, score, 0.0)]
    for level in range(levels):
        last, by = out[-1], -(2**level)
        right = jnp.maximum(last, jnp.roll(last, by, 1))
        out.append(jnp.maximum(right, jnp.roll(right, by, 0)))
    return tuple(out)


def correlate(
    levels: tuple[Float[Array, "C C"], ...],
    points: Float[Array, "B 2"],
    valid: Bool[Array, "B"],
    start: Float[Array, "3"],
    prior_information: Float[Array, "3 3"],
    window: Window,
) -> Found:
    """The best pose of a lattice around a start, by blocks from coarse to fine.

    It maximizes the mean score of the points less `PENALTY` δᵀ Λ δ, δ the way from the start.

    A block's bound is the score with each cell's largest neighbour (Olson 2009, "Real-time
    correlative scan matching", ICRA); the best `kept` blocks of a level are divided into four.
    """
    size = levels[0].shape[0]
    angles = start[2] + window.turn * jnp.arange(-window.turns, window.turns + 1, dtype=jnp.float32)
    cos, sin = jnp.cos(angles)[:, None], jnp.sin(angles)[:, None]
    px, py = points[None, :, 0], points[None, :, 1]
    x = cos * px - sin * py + start[0]
    y = sin * px + cos * py + start[1]
    column = jnp.floor(x / CELL).astype(jnp.int32) + HALF  # (angles, points)
    row = jnp.floor(y / CELL).astype(jnp.int32) + HALF
    count = jnp.maximum(valid.sum(), 1)

    def score(level: int, a: Array, i: Array, j: Array) -> Array:
        """Of candidates (n,): angle, rows and columns of the shift."""
        r = jnp.clip(row[a] + i[:, None], 0, size - 1)
        c = jnp.clip(column[a] + j[:, None], 0, size - 1)
        seen = (
            jnp.where(valid[None, :], levels[level].reshape(-1)[r * size + c], 0.0).sum(axis=1)
            / count
        )
        off = jnp.stack([j * CELL, i * CELL, angles[a] - start[2]], axis=1)
        return seen - PENALTY * ((off @ prior_information) * off).sum(axis=1)

    step = 2**window.level
    shift = step * jnp.arange(-window.blocks, window.blocks + 1, dtype=jnp.int32)
    turn = jnp.arange(2 * window.turns + 1, dtype=jnp.int32)

    def of_angle(a: Array) -> Array:
        i, j = (each.reshape(-1) for each in jnp.meshgrid(shift, shift, indexing="ij"))
        return score(window.level, jnp.full_like(i, a), i, j)

    coarse = jax.lax.map(of_angle, turn)
    per = len(shift) ** 2
    best, at = jax.lax.top_k(coarse.reshape(-1), min(window.kept, coarse.size))
    a, i, j = at // per, shift[at % per // len(shift)], shift[at % len(shift)]
    for level in range(window.level - 1, -1, -1):
        half = 2**level
        a = jnp.repeat(a, 4)
        i = jnp.repeat(i, 4) + jnp.tile(jnp.array([0, 0, half, half], jnp.int32), len(best))
        j = jnp.repeat(j, 4) + jnp.tile(jnp.array([0, half, 0, half], jnp.int32), len(best))
        best = score(level, a, i, j)
        if level:
            best, top = jax.lax.top_k(best, min(window.kept, len(best)))
            a, i, j = a[top], i[top], j[top]
    top = jnp.argmax(best)
    apart = (jnp.hypot((i - i[top]) * CELL, (j - j[top]) * CELL) > 0.5) | (
        jnp.abs(a - a[top]) * window.turn > 0.17
    )
    pose = jnp.stack([start[0] + j[top] * CELL, start[1] + i[top] * CELL, angles[a[top]]])
    return Found(pose, best[top], jnp.where(apart, best, 0.0).max())


def fit_lines(
    reference: Reference,
    points: Float[Array, "B 2"],
    valid: Bool[Array, "B"],
    start: Float[Array, "3"],
    prior: Float[Array, "3"],
    prior_information: Float[Array, "3 3"],
    *,
    iterations: int = 10,
    width: float = 0.05,
) -> Fitted:
    """The pose that brings the points onto the walls of the reference, from a start.

    Each point is paired with the nearest of the reference, at a gap g. Where that has a line the
    distance is nᵀg (Censi 2008, "An ICP variant using a point-to-line metric", ICRA), elsewhere,
    as in clutter, `POINT` |g|. Gauss-Newton steps on Σ ρ(e²) + (x - prior)ᵀ Λ (x - prior), e the
    distance and ρ Cauchy's kernel. The reach of a pair shrinks from 0.5 m to 0.15 m.

    prior_information: Λ, times σ²: of the coordinates.
    """
    squares = jnp.where(reference.valid, (reference.points**2).sum(axis=1), jnp.inf)

    def paired(pose: Array) -> tuple[Array, Array, Array, Array]:
        """(two residuals, their derivatives, distance, how far the pair is) of each point."""
        c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
        turned = jnp.stack(
            [c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]], axis=1
        )
        there = turned + pose[None, :2]
        near = _nearest(there, reference.points, squares)
        gap = there - reference.points[near]
        normal = reference.normals[near]
        line = jnp.abs(normal).sum(axis=1) > 0
        # Both residuals of a pair, as rows of a (2, 2) matrix times the gap.
        one = jnp.where(line[:, None], normal, POINT * jnp.array([[1.0, 0.0]], normal.dtype))
        other = jnp.where(line[:, None], 0.0, POINT * jnp.array([[0.0, 1.0]], normal.dtype))
        rows = jnp.stack([one, other], axis=1)  # (B, 2, 2)
        e = (rows * gap[:, None, :]).sum(axis=2)
        across = jnp.stack([-turned[:, 1], turned[:, 0]], axis=1)
        by = jnp.concatenate([rows, (rows * across[:, None, :]).sum(axis=2, keepdims=True)], axis=2)
        away = jnp.hypot(*gap.T)
        distance = jnp.hypot(*e.T)
        # Along a wall the next point of the reference may be farther.
        return e, by, distance, jnp.where(line, away - 0.15, away)

    def weights(distance: Array, away: Array, reach: Array) -> Array:
        near = valid & (distance < reach) & (away < reach)
        return jnp.where(near, 1.0 / (1.0 + (distance / width) ** 2), 0.0)

    def information_of(by: Array, w: Array) -> Array:
        flat = by.reshape(-1, 3)
        return (flat * jnp.repeat(w, 2)[:, None]).T @ flat

    def step(k: Array, pose: Array) -> Array:
        reach = jnp.float32(0.5) * jnp.float32(0.3) ** (k / (iterations - 1))
        e, by, distance, away = paired(pose)
        w = weights(distance, away, reach)
        off = pose - prior
        off = off.at[2].set(jnp.arctan2(jnp.sin(off[2]), jnp.cos(off[2])))
        regular = prior_information + 1e-6 * jnp.eye(3, dtype=by.dtype)
        slope = (by * (w[:, None] * e)[:, :, None]).sum(axis=(0, 1)) + prior_information @ off
        return pose - _solved(information_of(by, w) + regular, slope)

    pose = jax.lax.fori_loop(0, iterations, step, start)
    _, by, distance, away = paired(pose)
    w = weights(distance, away, jnp.float32(0.15))
    total = jnp.maximum(w.sum(), 1e-6)
    return Fitted(
        pose.at[2].set(jnp.arctan2(jnp.sin(pose[2]), jnp.cos(pose[2]))),
        information_of(by, w),
        jnp.sqrt((w * distance**2).sum() / total),
        (valid & (distance < 0.1) & (away < 0.15)).sum() / jnp.maximum(valid.sum(), 1),
    )


def _nearest(
    points: Float[Array, "B 2"], of: Float[Array, "R 2"], squares: Float[Array, "R"]
) -> Int[Array, "B"]:
    """The index of a nearest of R points for each of B, up to a part in 1,000 of the distance.

    The index stands in the last bits of the squared distance, so that a minimum of integers finds
    both: on a CPU far faster than `argmin`, which is not vectorized.
    """
    bits = max(len(of) - 1, 1).bit_length()
    squared = squares[None, :] - 2 * points @ of.T + (points**2).sum(axis=1)[:, None]
    squared = jnp.clip(squared, 1e-12, 1e12)
    whole = jax.lax.bitcast_convert_type(squared, jnp.int32)
    mask = jnp.int32((1 << bits) - 1)
    index = jnp.arange(len(of), dtype=jnp.int32)[None, :]
    return ((whole & ~mask) | index).min(axis=1) & mask


def gathered(
    points: Float[Array, "n B 2"],
    normals: Float[Array, "n B 2"],
    valid: Bool[Array, "n B"],
    poses: Float[Array, "n 3"],
) -> Reference:
    """The points of some scans in the frame in which their poses are."""
    c, s = jnp.cos(poses[:, 2, None]), jnp.sin(poses[:, 2, None])

    def turned(v: Array) -> Array:
        return jnp.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1]], axis=-1)

    there = turned(points) + poses[:, None, :2]
    return Reference(there.reshape(-1, 2), turned(normals).reshape(-1, 2), valid.reshape(-1))


def _solved(matrix: Float[Array, "3 3"], right: Float[Array, "3"]) -> Float[Array, "3"]:
    """The solution of three equations, by the adjugate."""
    a, b, c = matrix
    adjugate = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=1)
    return adjugate @ right / (a @ adjugate[:, 0])
