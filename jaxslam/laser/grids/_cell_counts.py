"""Maps from scans at known poses: hits and misses of each cell, and the log-odds by them."""

import math
from functools import partial
from numbers import Integral
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, PyTree

from jaxslam.core._numbers import is_concrete
from jaxslam.core.types import Beams, JaxOrNumPy
from jaxslam.core.validation import (
    InvalidField,
    finite,
    instance_of,
    mounting_pose,
    positive,
    refusals_of,
    require,
)
from jaxslam.laser.grids._grid import Grid, to_cells
from jaxslam.laser.grids.beam_models._beam_model import usable_beams
from jaxslam.math import se2
from jaxslam.math._arrays import Number, in_dtype
from jaxslam.math._xla import hot_jit

_FARTHEST = 2.0**29
"""[cells] Ends of beams farther off count as this far: the number of cells crossed, the sum along
two axes, must fit into an int32."""


class Counts(NamedTuple):
    """The numbers of beams that ended in each cell, and that passed through it."""

    hits: Int[JaxOrNumPy, "H W"]
    misses: Int[JaxOrNumPy, "H W"]
    origin: Float[JaxOrNumPy, "3"]
    resolution: Float[JaxOrNumPy, ""]
    outside: Int[JaxOrNumPy, ""]
    """usable beams without effect: their origin is off the map"""
    unusable: Int[JaxOrNumPy, ""]
    """beams without information: not valid, or of a range of 0, below 0 or NaN (`Beams`)"""


def count(
    shape: tuple[int, int],
    origin: ArrayLike,
    resolution: ArrayLike,
    poses: Float[JaxOrNumPy, "T 3"],
    beams: Beams,
    *,
    max_range: float,
    no_return: float | None = None,
    mount: ArrayLike | tuple[float, ...] = (0.0, 0.0, 0.0),
) -> Counts:
    """The hits and misses of a map of (H, W) cells by T scans at known poses.

    A beam misses each cell that it crosses, in order (Amanatides & Woo 1987), and hits the cell in
    which it ends. A beam of max_range or more hits nothing, and misses the cells up to no_return; a
    no_return of 0 leaves it out. `Beams` says what other ranges mean. Cells off the map are not
    counted. The counts are sums of integers: the order of the scans does not matter, and the counts
    of two logs add.

    Args:
        origin, resolution: of the map, as in `Grid`.
        no_return: [m] how far a beam of max_range is free; None for max_range. A laser that misses
            black or wet walls needs less.
        poses: of the robot. beams: with leading T. max_range: [m].
        mount: (3,) pose of the laser on the robot.
    Raises:
        ValueError: a shape, a frame, a mount, poses and beams that do not fit; outside a trace, no
            usable beam, or a usable pose that is not finite.
    """
    if np.shape(shape) != (2,) or not all(isinstance(n, Integral) and n >= 1 for n in shape):
        reason = f"expected (H, W), integers, of at least one cell, got {shape!r}"
        raise InvalidField("shape", reason, owner="count")
    with refusals_of("count"):
        require("origin", origin, finite(3))
        require("resolution", resolution, positive)
        require("mount", mount, mounting_pose)
        require("beams", beams, instance_of(Beams))
        if not all(hasattr(part, "dtype") for part in beams):
            kinds = ", ".join(type(part).__name__ for part in beams)
            raise InvalidField("beams", f"expected ranges, angles and masks in arrays, got {kinds}")
        shapes = [np.shape(part) for part in beams]
        if len(set(shapes)) != 1 or len(shapes[0]) != 2:
            raise InvalidField(
                "beams", f"expected as many ranges, angles and masks (T, B), got {shapes}"
            )
        if np.shape(poses) != (shapes[0][0], 3):
            raise InvalidField(
                "poses",
                f"expected one (x, y, θ) for each of {shapes[0][0]} scans, got {np.shape(poses)}",
            )
        require("max_range", max_range, positive)
        if is_concrete(beams, poses):
            if not np.all(np.isfinite(poses)):
                raise InvalidField("poses", "expected finite numbers")
            if not np.any(usable_beams(Beams(*map(np.asarray, beams)))):
                raise InvalidField("beams", "no scan has a valid beam")
        free = max_range if no_return is None else no_return
        if not 0 <= free <= max_range:
            raise InvalidField(
                "no_return", f"expected a number from 0 to {max_range}, got {no_return}"
            )
    frame = jnp.asarray(origin, float), jnp.asarray(resolution, float)
    eye = jnp.asarray(mount, float)
    poses, beams = in_dtype((poses, beams), eye.dtype)
    size = int(shape[0]), int(shape[1])
    return _count(size, *frame, poses, beams, max_range, free, eye)


@partial(hot_jit, static_argnames=("shape",))
def _count(
    shape: tuple[int, int],
    origin: Array,
    resolution: Array,
    poses: Array,
    beams: Beams,
    max_range: Array,
    free: Array,
    mount: Array,
) -> Counts:
    height, width = shape

    def add_scan(total: PyTree, row: tuple[Array, Beams]) -> tuple[PyTree, None]:
        hits, misses, outside, unusable = total
        pose, scan = row
        eye = se2.compose(pose, mount)
        met, far = scan.returns(jnp.asarray(max_range))
        usable = met | far
        length = jnp.where(met, scan.range, jnp.where(far, free, 0.0))
        heading = eye[2] + jnp.where(usable, scan.angle, 0.0)
        e = jnp.stack([jnp.cos(heading), jnp.sin(heading)], axis=-1)
        ends = to_cells(origin, resolution, eye[None, :2] + length[:, None] * e)
        start = to_cells(origin, resolution, eye[:2])
        inside = (start >= 0).all() & (start[0] < width) & (start[1] < height)
        # Without free space before a beam of max_range it has no effect, not even on the laser's
        # cell.
        live = inside & usable & ~(far & (jnp.asarray(free) <= 0))
        misses, last = _cross(misses, jnp.broadcast_to(start, ends.shape), ends, live, shape)
        on_map = (ends >= 0).all(axis=1) & (ends[:, 0] < width) & (ends[:, 1] < height)
        at = jnp.where(live & on_map, last, len(hits))
        hits = hits.at[at].add((~far).astype(jnp.int32), mode="drop")
        misses = misses.at[at].add(far.astype(jnp.int32), mode="drop")
        # The usable beams of a scan from a pose off the map.
        lost = jnp.where(inside, 0, usable.sum(dtype=jnp.int32))
        unusable = unusable + (~usable_beams(scan)).sum(dtype=jnp.int32)
        return (hits, misses, outside + lost, unusable), None

    # Flat tables with an index beyond the end for what is not counted: scatters of mode "drop".
    empty = jnp.zeros(height * width, jnp.int32)
    zero = jnp.zeros((), jnp.int32)
    total, _ = jax.lax.scan(add_scan, (empty, empty, zero, zero), (poses, beams))
    return Counts(total[0].reshape(shape), total[1].reshape(shape), origin, resolution, *total[2:])


def _cross(
    misses: Array, start: Array, ends: Array, live: Array, shape: tuple[int, int]
) -> tuple[Array, Array]:
    """The misses with each cell from start up to the last one, without it; and its index.

    A beam crosses as many lines of the table as lie between the two cells; a beam that leaves the
    map does not return.
    """
    height, width = shape
    nowhere = misses.shape[0]
    delta = ends - start
    forward = jnp.where(delta >= 0, 1, -1).astype(jnp.int32)
    first = jnp.floor(start).astype(jnp.int32)
    last = jnp.floor(jnp.clip(ends, -_FARTHEST, _FARTHEST)).astype(jnp.int32)
    # One step for each line between the two cells: the loop ends without comparing lengths, whose
    # rounding could miss the last cell.
    steps = jnp.where(live, jnp.abs(last - first).sum(axis=1), 0)
    slope = jnp.where(delta != 0, 1.0 / jnp.where(delta != 0, delta, 1.0), 0.0)

    def goes_on(state: tuple[Array, ...]) -> Array:
        return (state[2] < steps).any()

    def step(state: tuple[Array, ...]) -> tuple[Array, ...]:
        misses, cell, arrived = state
        going = arrived < steps
        inside = (cell >= 0).all(axis=1) & (cell[:, 0] < width) & (cell[:, 1] < height)
        at = jnp.where(going & inside, cell[:, 1] * width + cell[:, 0], nowhere)
        misses = misses.at[at].add(1, mode="drop")
        # The share of the beam up to the next line of each axis; none where the end is reached.
        line = (cell + (forward > 0).astype(jnp.int32)).astype(start.dtype)
        crossing = (line - start) * slope
        crossing = jnp.where(cell == last, jnp.inf, crossing)
        across = crossing[:, 0] < crossing[:, 1]
        move = jnp.where(jnp.stack([across, ~across], axis=1), forward, 0)
        arrived = jnp.where(inside, arrived + going.astype(steps.dtype), steps)
        return misses, jnp.where(going[:, None], cell + move, cell), arrived

    begin: tuple[Array, ...] = (misses, first, jnp.zeros_like(steps))
    misses, *_ = jax.lax.while_loop(goes_on, step, begin)
    return misses, last[:, 1] * width + last[:, 0]


def occupancy(counts: Counts, *, hit: Number = 0.7, miss: ArrayLike = 0.4) -> Grid:
    """The log-odds of an inverse sensor model: hits · logit(hit) + misses · logit(miss).

    As the occupancy-grid filter sums them beam by beam, with a prior of ½ (Thrun, Burgard & Fox
    2005, "Probabilistic robotics", table 9.1). A cell of no beam has exactly 0. Cells and beams are
    taken to be independent, so the log-odds are overconfident. Differentiable by both numbers.

    Raises ValueError unless 0 < miss < ½ < hit < 1.
    """
    if (
        is_concrete(hit, miss)
        and not 0 < float(np.asarray(miss)) < 0.5 < float(np.asarray(hit)) < 1
    ):
        raise InvalidField(
            "", f"expected 0 < miss < 0.5 < hit < 1, got {miss!r} and {hit!r}", owner="occupancy"
        )
    log_hit = jnp.log(hit) - jnp.log1p(-jnp.asarray(hit))
    log_miss = jnp.log(miss) - jnp.log1p(-jnp.asarray(miss))
    dtype = jnp.result_type(log_hit, log_miss)
    log_odds = counts.hits.astype(dtype) * log_hit + counts.misses.astype(dtype) * log_miss
    return Grid(log_odds, counts.origin, counts.resolution)


def reflection(counts: Counts, *, prior: ArrayLike = 1.0) -> Grid:
    """The counting model: p = (hits + prior)/(hits + misses + 2 prior), how often a cell reflects.

    The mean of a Beta(prior, prior) distribution updated by the counts. A cell of no beam has a
    log-odds of exactly 0; the counts, not the grid, show how certain p is.

    Raises ValueError unless prior is above 0.
    """
    if is_concrete(prior) and not float(np.asarray(prior)) > 0:
        raise InvalidField("prior", f"expected a number above 0, got {prior!r}", owner="reflection")
    dtype = jnp.result_type(prior, float)
    hits, misses = counts.hits.astype(dtype), counts.misses.astype(dtype)
    log_odds = jnp.log(hits + prior) - jnp.log(misses + prior)
    return Grid(log_odds, counts.origin, counts.resolution)


def entropy(grid: Grid) -> Float[Array, "H W"]:
    """The entropy -p log₂ p - (1 - p) log₂(1 - p) [bit] of each cell: 1 where it is unknown."""
    size = jnp.abs(grid.log_odds)
    odds = jnp.exp(-size)
    # The larger share is 1/(1 + odds), with -log of log1p(odds); the smaller has `size` more.
    nats = jnp.log1p(odds) + size * odds / (1 + odds)
    return jnp.asarray(nats / math.log(2.0))
