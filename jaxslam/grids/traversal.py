"""Rays through a table of squares: every square that a ray crosses, or long steps where it may."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

STOP, OFF = -1.0, -2.0
"""Squares in which a ray may end, and squares off the map."""

CHUNK = 32
"""Rays that a CPU advances together. A loop runs until the longest ray of a chunk ends, so the
fewer the better; 32 fill its vectors."""


@jax.custom_batching.custom_vmap
def march(
    ahead: Float[Array, "H W"],
    corners: Float[Array, "H2 W2"] | None,
    start: Float[Array, "R 2"],
    direction: Float[Array, "R 2"],
    limit: Float[Array, ""],
) -> tuple[Float[Array, "R"], Bool[Array, "R"]]:
    """The length [squares] of rays up to an obstacle, and whether they meet one within the limit.

    ahead has a border of `OFF` around the squares; start (x, y) counts from the corner of the first
    square within. corners None: a ray ends where it enters a square that is `STOP`. Else it ends in
    such a square where the bilinear interpolation of its four corners is 0, if it is. Rays of a
    batch under `vmap` are as many rays of one call.
    """
    return _march(ahead, corners, start, direction, limit)


@march.def_vmap
def _over_batch(size: int, batched: PyTree, *arguments: PyTree) -> tuple[PyTree, PyTree]:
    ahead, corners, *rays, limit = arguments
    on_rays = batched[2:4]
    if any(jax.tree.leaves((batched[:2], batched[4]))):  # maps vary
        axes = jax.tree.map(lambda on: 0 if on else None, tuple(batched))
        return jax.vmap(_march, in_axes=axes)(*arguments), (True, True)
    each = [
        x if on else jnp.broadcast_to(x, (size, *x.shape))
        for x, on in zip(rays, on_rays, strict=True)
    ]
    # The rays of one beam from all poses lie together: of poses close together they are as long.
    flat = [x.swapaxes(0, 1).reshape(-1, 2) for x in each]
    found = march(ahead, corners, *flat, limit)
    return jax.tree.map(lambda x: x.reshape(-1, size).T, found), (True, True)


def _march(
    ahead: Array, corners: Array | None, start: Array, direction: Array, limit: Array
) -> tuple[Array, Array]:
    count = start.shape[0]
    if count <= CHUNK or jax.default_backend() != "cpu":
        return _together(ahead, corners, start, direction, limit)
    parts = -(-count // CHUNK)
    padded = parts * CHUNK - count

    def split(x: Array) -> Array:
        return jnp.pad(x, [(0, padded), (0, 0)], mode="edge").reshape(parts, CHUNK, 2)

    length, hit = jax.lax.map(
        lambda rays: _together(ahead, corners, rays[0], rays[1], limit),
        (split(start), split(direction)),
    )
    return length.reshape(-1)[:count], hit.reshape(-1)[:count]


def _together(
    ahead: Array, corners: Array | None, start: Array, direction: Array, limit: Array
) -> tuple[Array, Array]:
    height, width = ahead.shape
    flat = ahead.reshape(-1)
    x0, y0, dx, dy = start[:, 0] + 1, start[:, 1] + 1, direction[:, 0], direction[:, 1]
    right, up = dx > 0, dy > 0
    # A ray along an axis never crosses lines of the other: its crossing is at infinity.
    over_x = jnp.where(dx != 0, 1.0 / jnp.where(dx != 0, dx, 1.0), 0.0)
    over_y = jnp.where(dy != 0, 1.0 / jnp.where(dy != 0, dy, 1.0), 0.0)
    far_x, far_y = jnp.where(dx != 0, 0.0, jnp.inf), jnp.where(dy != 0, 0.0, jnp.inf)

    def column(x: Array) -> Array:
        return jnp.clip(jnp.floor(x), 0, width - 1)

    def row(y: Array) -> Array:
        return jnp.clip(jnp.floor(y), 0, height - 1)

    def unfinished(state: tuple[Array, ...]) -> Array:
        return state[-1].any()

    def step(state: tuple[Array, ...]) -> tuple[Array, ...]:
        x, y, length, found, live = state
        place = y.astype(jnp.int32) * width + x.astype(jnp.int32)
        here = flat[place]
        exit_x = (x + right - x0) * over_x + far_x
        exit_y = (y + up - y0) * over_y + far_y
        leaves = jnp.minimum(exit_x, exit_y)
        stop = here == STOP
        if corners is None:
            ends = stop
            end = length
        else:
            end, crosses = _surface(corners, x, y, x0, y0, dx, dy, length, leaves)
            ends = stop & crosses
        found = found | (live & ends & (end < limit))
        length_ends = jnp.where(ends, end, length)
        goes = live & ~ends & (here != OFF) & (leaves < limit)
        jump = length + here
        far = (here > 0) & (jump > leaves)
        after = jnp.where(far, jump, jnp.maximum(leaves, length))
        first = exit_x < exit_y
        step_x = jnp.where(first, x + jnp.where(right, 1.0, -1.0), x)
        step_y = jnp.where(first, y, y + jnp.where(up, 1.0, -1.0))
        next_x = jnp.where(far, column(x0 + jump * dx), step_x)
        next_y = jnp.where(far, row(y0 + jump * dy), step_y)
        return (
            jnp.where(goes, next_x, x),
            jnp.where(goes, next_y, y),
            jnp.where(goes, after, jnp.where(live, length_ends, length)),
            found,
            goes,
        )

    x, y = column(x0), row(y0)
    inside = (x0 >= 1) & (x0 <= width - 1) & (y0 >= 1) & (y0 <= height - 1)
    # A start on the upper border belongs to the last square.
    x, y = jnp.minimum(x, width - 2.0), jnp.minimum(y, height - 2.0)
    zero = jnp.zeros_like(x0)
    start_state: tuple[Array, ...] = (x, y, zero, jnp.zeros_like(inside), inside)
    _, _, length, found, _ = jax.lax.while_loop(unfinished, step, start_state)
    return jnp.where(found, length, limit), found


def _surface(
    corners: Array,
    x: Array,
    y: Array,
    x0: Array,
    y0: Array,
    dx: Array,
    dy: Array,
    begins: Array,
    ends: Array,
) -> tuple[Array, Array]:
    """Where a ray meets the surface f = 0 in a square, and whether it does there.

    With u, v the coordinates in the square where the ray enters it, and s the length from there,
    f = f00 + b u + c v + e u v is (f00 + b u + c v + e u v) + s (b dx + c dy + e (u dy + v dx))
    + s² e dx dy. A ray that begins in f > 0 ends at once.
    """
    width = corners.shape[1]
    at = (y.astype(jnp.int32) - 1) * width + x.astype(jnp.int32) - 1
    flat = corners.reshape(-1)
    f00, f10, f01, f11 = flat[at], flat[at + 1], flat[at + width], flat[at + width + 1]
    u, v = x0 + begins * dx - x, y0 + begins * dy - y
    b, c, e = f10 - f00, f01 - f00, f00 - f10 - f01 + f11
    constant = f00 + b * u + c * v + e * u * v
    linear = b * dx + c * dy + e * (u * dy + v * dx)
    square = e * dx * dy
    disc = linear * linear - 4.0 * square * constant
    half = -0.5 * (linear + jnp.where(linear >= 0, 1.0, -1.0) * jnp.sqrt(jnp.maximum(disc, 0.0)))
    one = jnp.where(square != 0, half / jnp.where(square != 0, square, 1.0), jnp.inf)
    two = jnp.where(half != 0, constant / jnp.where(half != 0, half, 1.0), jnp.inf)
    # Rounding may put a root a little before the square.
    least = -1e-4
    one, two = jnp.where(one >= least, one, jnp.inf), jnp.where(two >= least, two, jnp.inf)
    root = jnp.maximum(jnp.minimum(one, two), 0.0)
    root = jnp.where(constant > 0, 0.0, root)
    meets = (constant > 0) | ((disc >= 0) & (begins + root <= ends + 1e-4))
    return begins + root, meets
