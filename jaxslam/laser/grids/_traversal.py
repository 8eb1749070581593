"""Rays through a table of squares: square by square, or in long steps through free space."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree, UInt8

from jaxslam.math._xla import one_kernel

STOP, OFF = 255, 254
"""Squares in which a ray may end, and squares off the map: the two bytes above `MOST`."""

MOST = 253
"""Longest step [quarters of a square]: steps are bytes, so that more of a map fits into a
processor's cache."""

_ROUNDING = 1e-3
"""Tolerance [squares] for a ray that ends off the map, of float32 coordinates in large maps."""

_BEFORE_START = 1e-4
"""[squares] that rounding may put a root before the start of its parabola."""

_CHUNK = 32
"""Rays that a CPU advances together. A loop runs until the longest ray of a chunk ends, so fewer
rays are better; 32 fill its vectors."""


@jax.custom_batching.custom_vmap
def march(
    ahead: UInt8[Array, "H W"],
    corners: Float[Array, "H2 W2"] | None,
    start: Float[Array, "R 2"],
    direction: Float[Array, "R 2"],
    limit: Float[Array, ""],
) -> tuple[Float[Array, "R"], Bool[Array, "R"]]:
    """The length [squares] of rays up to an obstacle, and whether they meet one within the limit.

    Without corners a ray ends where it enters a square that is `STOP`. With corners it ends in such
    a square where the bilinear interpolation of the four corners is 0, if it is 0 anywhere, and the
    outer half of the outermost squares is off the map. Rays of a batch under `vmap` become rays of
    a single call.

    Args:
        ahead: of each square, how far a ray may go from anywhere in it [quarters of a square], or
            `STOP` or `OFF`; the border is `OFF`.
        corners: values at the corners of the squares.
        start: (x, y) [squares] from the corner of the first square within the border.
        direction: unit vectors.
        limit: largest length [squares].
    """
    return _march(ahead, corners, start, direction, limit)


@march.def_vmap
def _over_batch(size: int, batched: PyTree, *arguments: PyTree) -> tuple[PyTree, PyTree]:
    ahead, corners, *rays, limit = arguments
    if any(jax.tree.leaves((batched[:2], batched[4]))):  # maps vary
        axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, tuple(batched))
        return jax.vmap(_march, in_axes=axes)(*arguments), (True, True)
    rays = [
        part if is_batched else jnp.broadcast_to(part, (size, *part.shape))
        for part, is_batched in zip(rays, batched[2:4], strict=True)
    ]
    # (pose, beam) to (beam, pose): rays of a beam from close poses are about as long, and a loop
    # runs until the longest ray of a chunk ends.
    flat = [part.swapaxes(0, 1).reshape(-1, 2) for part in rays]
    lengths_and_hits = march(ahead, corners, *flat, limit)
    return jax.tree.map(lambda part: part.reshape(-1, size).T, lengths_and_hits), (True, True)


def _march(
    ahead: Array, corners: Array | None, start: Array, direction: Array, limit: Array
) -> tuple[Array, Array]:
    count = start.shape[0]
    if count <= _CHUNK or jax.default_backend() != "cpu":
        return one_kernel(_march_together, ahead, corners, start, direction, limit)
    chunks = -(-count // _CHUNK)
    padding = chunks * _CHUNK - count

    def split(part: Array) -> Array:
        return jnp.pad(part, [(0, padding), (0, 0)], mode="edge").reshape(chunks, _CHUNK, 2)

    length, hit = jax.lax.map(
        lambda rays: one_kernel(_march_together, ahead, corners, rays[0], rays[1], limit),
        (split(start), split(direction)),
    )
    return length.reshape(-1)[:count], hit.reshape(-1)[:count]


class _Rays(NamedTuple):
    """The constants of rays; a suffix names the axis."""

    x: Array
    y: Array
    """start [squares], from the corner of the border"""
    dx: Array
    dy: Array
    """direction"""
    over_x: Array
    over_y: Array
    """1/dx and 1/dy, 0 for a ray along the other axis"""
    far_x: Array
    far_y: Array
    """infinite for a ray along the other axis, which crosses no line of this one; else 0"""


class _Square(NamedTuple):
    """The squares (x, y) in which rays are, and the lengths of the rays so far."""

    x: Array
    y: Array
    length: Array


class _March(NamedTuple):
    """Rays on their way."""

    at: _Square
    moving: Array
    """mask of the rays that go on"""
    met: Array
    """mask of the rays that have met a `STOP`, or with corners the surface in one"""


def _march_together(
    ahead: Array, corners: Array | None, start: Array, direction: Array, limit: Array
) -> tuple[Array, Array]:
    """`march` of rays that advance in a common loop.

    | square of a ray | without corners | with corners |
    |---|---|---|
    | free | moves on | moves on |
    | `STOP` | hit | hit where the parabola is 0, else moves on |
    | `OFF`, or left beyond the limit | ends without a hit | ends without a hit |
    """
    height, width = ahead.shape
    x, y = start[:, 0] + 1, start[:, 1] + 1  # from the corner of the border, a square wide
    # Squares of corners reach half a square beyond the map: a hit there is off the map.
    edge = 1.0 if corners is None else 1.5 - _ROUNDING

    def on_map(x: Array, y: Array) -> Array:
        return (x >= edge) & (x <= width - edge) & (y >= edge) & (y <= height - edge)

    inside = on_map(x, y)
    x, y = jnp.where(inside, x, 1.0), jnp.where(inside, y, 1.0)
    over = jnp.where(direction != 0, 1.0 / jnp.where(direction != 0, direction, 1.0), 0.0)
    far = jnp.where(direction != 0, 0.0, jnp.inf)
    rays = _Rays(x, y, *direction.T, *over.T, *far.T)
    # A start on the upper border belongs to the last square.
    first = _Square(
        jnp.floor(jnp.minimum(x, width - 1.5)),
        jnp.floor(jnp.minimum(y, height - 1.5)),
        jnp.zeros_like(x),
    )
    begin = _March(first, inside, jnp.zeros_like(inside))

    def any_moves(march: _March) -> Array:
        return march.moving.any()

    def step(march: _March) -> _March:
        """Each ray moved over what is free ahead of it; a `STOP` ends its way."""
        at, moving, met = march
        reach = _entries(ahead, at.x, at.y)
        crosses = _crossings(rays, at)
        goes = moving & (reach < OFF) & (jnp.minimum(*crosses) < limit)
        after = _next_square(rays, at, crosses, reach.astype(x.dtype) * 0.25)  # of quarters
        return _March(_select(goes, after, at), goes, met | (moving & (reach == STOP)))

    if corners is None:
        at, _, met = jax.lax.while_loop(any_moves, step, begin)
        hit = met & (at.length < limit)
        return jnp.where(hit, at.length, limit), hit

    def visit(march: _March) -> _March:
        """Rays moved to the next `STOP`, and out of it if the surface is not in it."""
        none_met = march._replace(met=jnp.zeros_like(march.met))
        if jax.default_backend() == "cpu":
            at, moving, stopped = jax.lax.while_loop(any_moves, step, none_met)
        else:  # one step, since on a GPU all rays would wait for the longest
            at, moving, stopped = step(none_met)
        crosses = _crossings(rays, at)
        leaves = jnp.minimum(*crosses)
        meets = _has_root(_parabola(corners, rays, at), leaves - at.length)
        goes = stopped & ~meets & (leaves < limit)
        after = _next_square(rays, at, crosses, jnp.zeros_like(leaves))
        return _March(_select(goes, after, at), moving | goes, march.met | (stopped & meets))

    at, _, met = jax.lax.while_loop(any_moves, visit, begin)
    length = at.length + _root(_parabola(corners, rays, at))
    hit = met & on_map(rays.x + length * rays.dx, rays.y + length * rays.dy) & (length < limit)
    return jnp.where(hit, length, limit), hit


def _entries(table: Array, x: Array, y: Array) -> Array:
    """The entries (y, x) of a table; the indices must be in it."""
    # A flat index without bounds checks: a gather of two indices takes longer.
    flat = y.astype(jnp.int32) * table.shape[1] + x.astype(jnp.int32)
    return table.reshape(-1).at[flat].get(mode="promise_in_bounds", wrap_negative_indices=False)


def _select(goes: Array, after: _Square, at: _Square) -> _Square:
    """The square after a step for rays that go, else the square before."""
    return _Square(*(jnp.where(goes, a, b) for a, b in zip(after, at, strict=True)))


def _crossings(rays: _Rays, at: _Square) -> tuple[Array, Array]:
    """The lengths at which rays cross the next line of either axis."""
    right, up = (rays.dx > 0).astype(at.x.dtype), (rays.dy > 0).astype(at.y.dtype)
    exit_x = (at.x + right - rays.x) * rays.over_x + rays.far_x
    exit_y = (at.y + up - rays.y) * rays.over_y + rays.far_y
    return exit_x, exit_y


def _next_square(rays: _Rays, at: _Square, crosses: tuple[Array, Array], ahead: Array) -> _Square:
    """The square after a step: over the free distance, or the neighbour if that is farther."""
    exit_x, exit_y = crosses
    leaves, jump = jnp.minimum(exit_x, exit_y), at.length + ahead
    far, first = (ahead > 0) & (jump > leaves), exit_x < exit_y
    step_x = jnp.where(first, at.x + jnp.where(rays.dx > 0, 1.0, -1.0), at.x)
    step_y = jnp.where(first, at.y, at.y + jnp.where(rays.dy > 0, 1.0, -1.0))
    return _Square(
        jnp.where(far, jnp.floor(rays.x + jump * rays.dx), step_x),
        jnp.where(far, jnp.floor(rays.y + jump * rays.dy), step_y),
        jnp.where(far, jump, jnp.maximum(leaves, at.length)),
    )


def _parabola(corners: Array, rays: _Rays, at: _Square) -> tuple[Array, Array, Array]:
    """The interpolation of the corners along rays in their squares, by powers of the length.

    With u, v the coordinates in the square where the ray is now, and s the length from there,
    f = f00 + b u + c v + e u v is (f00 + b u + c v + e u v) + s (b dx + c dy + e (u dy + v dx))
    + s² e dx dy.
    """
    x, y = at.x - 1, at.y - 1
    f00, f10 = _entries(corners, x, y), _entries(corners, x + 1, y)
    f01, f11 = _entries(corners, x, y + 1), _entries(corners, x + 1, y + 1)
    u = rays.x + at.length * rays.dx - at.x
    v = rays.y + at.length * rays.dy - at.y
    b, c, e = f10 - f00, f01 - f00, f00 - f10 - f01 + f11
    linear = b * rays.dx + c * rays.dy + e * (u * rays.dy + v * rays.dx)
    return f00 + b * u + c * v + e * u * v, linear, e * rays.dx * rays.dy


def _has_root(parabola: tuple[Array, Array, Array], length: Array) -> Array:
    """Whether a parabola is above 0 at s = 0, at the length, or between."""
    value, slope, curve = parabola
    steepest = -2.0 * curve * length
    between = (curve < 0) & (slope > 0) & (slope < steepest) & (slope**2 >= 4.0 * curve * value)
    return (value > 0) | (value + length * (slope + length * curve) >= 0) | between


def _root(parabola: tuple[Array, Array, Array]) -> Array:
    """The first s >= 0 at which a parabola is 0; 0 where it begins above."""
    value, slope, curve = parabola
    root = jnp.sqrt(jnp.maximum(slope**2 - 4.0 * curve * value, 0.0))
    half = -0.5 * (slope + jnp.where(slope >= 0, root, -root))
    # The roots half/curve and value/half: without cancellation where slope² is much larger.
    s1 = jnp.where(curve != 0, half / jnp.where(curve != 0, curve, 1.0), jnp.inf)
    s2 = jnp.where(half != 0, value / jnp.where(half != 0, half, 1.0), jnp.inf)
    s1, s2 = (jnp.where(s >= -_BEFORE_START, s, jnp.inf) for s in (s1, s2))
    return jnp.where(value > 0, 0.0, jnp.maximum(jnp.minimum(s1, s2), 0.0))
