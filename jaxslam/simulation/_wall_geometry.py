"""Walls as segments and circles: exact ranges, free space, and the lines of the segments."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from jaxslam.core.types import JaxOrNumPy
from jaxslam.core.validation import InvalidField, refusals_of


class Walls(NamedTuple):
    """The walls of a world: closed chains of segments, and circles, which do not cross.

    A point is free if an odd number of walls encloses it: inside an outer wall, but not inside a
    pillar.
    """

    segments: Float[JaxOrNumPy, "K 2 2"]
    """both ends (x, y) of a segment [m]"""
    circles: Float[JaxOrNumPy, "C 3"]
    """centre (x, y) and radius of a circle [m]"""
    glass: Float[JaxOrNumPy, "K"] | None = None
    """share of beams that pass a segment, in [0, 1]; None without glass"""


def exact_ranges(
    world: Walls,
    pose: Float[Array, "3"],
    angles: Float[Array, "B"],
    max_range: float | Array,
    passes: Bool[Array, "B K"] | None = None,
) -> Float[Array, "B"]:
    """The range [m] of each beam to the nearest wall, at most max_range; exact.

    Glass is a wall like others, except for the segments that a beam `passes`.

    With o the origin and e the direction of the beam: the segment from a to b is met at
    r = (a - o) × (b - a)/(e × (b - a)), at the share (a - o) × e/(e × (b - a)) of its length; the
    circle of centre c and radius ρ at r = e·(c - o) ± sqrt(ρ² - |c - o|² + (e·(c - o))²).
    Differentiable by the pose and by the walls, but where a beam passes an edge.
    """
    ranges = wall_ranges(world, pose, angles, max_range, passes)
    return jnp.minimum(ranges.min(axis=1), max_range)


def wall_ranges(
    world: Walls,
    pose: Float[Array, "3"],
    angles: Float[Array, "B"],
    max_range: float | Array,
    passes: Bool[Array, "B K"] | None = None,
) -> Float[Array, "B N"]:
    """The range [m] of each beam to each single wall, max_range if the beam misses it.

    N = K + 2 C + 1: the K segments, both crossings of each circle, and max_range. The equations are
    those of `exact_ranges`.
    """
    dtype = jnp.result_type(pose, float)
    heading = pose[2] + angles
    e = jnp.stack([jnp.cos(heading), jnp.sin(heading)], axis=-1)[:, None, :]
    ranges = []
    if len(world.segments):
        a = jnp.asarray(world.segments[:, 0], dtype)[None] - pose[None, None, :2]
        along = jnp.asarray(world.segments[:, 1] - world.segments[:, 0], dtype)[None]
        parallel = _cross(e, along)
        safe = jnp.where(parallel == 0, 1.0, parallel)
        r, share = _cross(a, along) / safe, _cross(a, e) / safe
        met = (parallel != 0) & (r > 0) & (share >= 0) & (share <= 1)
        met = met if passes is None else met & ~passes
        ranges.append(jnp.where(met, r, max_range))
    if len(world.circles):
        c = jnp.asarray(world.circles[:, :2], dtype)[None] - pose[None, None, :2]
        ahead = (e * c).sum(axis=-1)
        reach = jnp.asarray(world.circles[:, 2], dtype)[None] ** 2 - (c * c).sum(axis=-1) + ahead**2
        root = jnp.sqrt(jnp.where(reach > 0, reach, 1.0))
        for r in (ahead - root, ahead + root):
            ranges.append(jnp.where((reach > 0) & (r > 0), r, max_range))
    return jnp.concatenate([*ranges, jnp.full((len(angles), 1), max_range, dtype)], axis=1)


def _cross(a: Array, b: Array) -> Array:
    """The cross product a × b of vectors in the plane."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def is_free(world: Walls, points: ArrayLike) -> Bool[np.ndarray, "..."]:
    """Whether points (…, 2) lie in free space: inside an odd number of walls; on the host."""
    p = np.asarray(points, np.float64)
    inside = np.zeros(p.shape[:-1], bool)
    for (ax, ay), (bx, by) in np.asarray(world.segments):
        over = (ay > p[..., 1]) != (by > p[..., 1])
        at = ax + (p[..., 1] - ay) * (bx - ax) / (by - ay if by != ay else 1.0)
        inside ^= over & (p[..., 0] < at)
    for x, y, radius in np.asarray(world.circles):
        inside ^= np.hypot(p[..., 0] - x, p[..., 1] - y) < radius
    return inside


def wall_lines(
    world: Walls,
) -> tuple[Float[np.ndarray, "N 2"], Int[np.ndarray, "K"]]:
    """The distinct lines (r, α) of the segments, as `sensors.Line` has them; the line of each.

    The normal (cos α, sin α) points into the wall, so a line has the side that it is seen from.
    Segments on one line with free space on the same side share it. Raises ValueError without a
    segment, and on one without free space on exactly one side.
    """
    ends = np.asarray(world.segments, np.float64)
    with refusals_of("wall_lines"):
        if not len(ends):
            raise InvalidField("world", "expected at least one segment")
        along = ends[:, 1] - ends[:, 0]
        length = np.hypot(along[:, 0], along[:, 1])
        if np.any(length == 0):
            raise InvalidField("", f"segment {int(np.argmin(length))} has no length")
    normal = np.stack([along[:, 1], -along[:, 0]], axis=1) / length[:, None]
    middle, step = ends.mean(axis=1), 1e-6 * (1 + np.abs(ends).max())
    before, behind = (is_free(world, middle + side * step * normal) for side in (-1, 1))
    if np.any(before == behind):
        raise InvalidField(
            "",
            f"segment {int(np.argmax(before == behind))} has no free side, or two",
            owner="wall_lines",
        )
    normal[behind] *= -1
    r = (normal * middle).sum(axis=1)
    lines: list[tuple[float, float, float]] = []
    index = np.zeros(len(ends), int)
    for k, (x, y, distance) in enumerate(zip(*normal.T, r, strict=True)):
        apart = [max(abs(x - a), abs(y - b), abs(distance - c)) for a, b, c in lines]
        index[k] = int(np.argmin(apart)) if apart and min(apart) < 1e-6 else len(lines)
        if index[k] == len(lines):
            lines.append((x, y, distance))
    x, y, r = np.array(lines).T
    return np.stack([r, np.arctan2(y, x)], axis=1), index
