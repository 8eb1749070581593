"""A laser scanner in a world of exact walls, and the information of its scan on the pose."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from jaxslam.core._numbers import as_array, is_concrete
from jaxslam.core._record import check_field, field, record, static
from jaxslam.core._reprs import short_repr
from jaxslam.core.protocols import Motion
from jaxslam.core.types import Beams, JaxOrNumPy
from jaxslam.core.validation import (
    InvalidField,
    in_range,
    instance_of,
    mounting_pose,
    or_none,
    positive,
    prng_key,
    refusals_of,
    require,
)
from jaxslam.math import se2
from jaxslam.math._arrays import Number, Pose
from jaxslam.simulation._wall_geometry import Walls, exact_ranges, wall_ranges
from jaxslam.simulation._worlds import drive

__all__ = [
    "Laser",
    "LaserHistory",
    "LaserWorld",
    "Observability",
    "scan",
    "scan_information",
    "scan_world",
    "true_ranges",
]


def _angles_of_beams(value: ArrayLike) -> ArrayLike:
    """The check of the angles (B,) of at least one beam, finite."""
    shape = np.shape(value)
    if len(shape) != 1 or 0 in shape or (is_concrete(value) and not np.all(np.isfinite(value))):
        raise ValueError(f"expected finite angles (at least 1,), got {shape}")
    return as_array(value)


@record
class Laser:
    """A 2-D laser scanner. Raises ValueError on numbers out of range."""

    angles: Float[JaxOrNumPy, "B"] = field(check=_angles_of_beams)
    """directions of the beams in the frame of the mount [rad]"""
    sigma: Number = field(default=0.02, check=positive)
    """standard deviation of a range [m]"""
    max_range: Number = field(default=10.0, check=positive)
    """[m]; a beam that meets nothing nearer has this range, without noise"""
    dropout: Number = field(default=0.0, check=in_range(0.0, 1.0))
    """share of the beams that return nothing, in [0, 1]; they are not valid"""
    mount: ArrayLike | None = field(default=None, check=or_none(mounting_pose))
    """(3,) pose on the robot"""

    def frame(self, pose: Pose) -> Pose:
        """The pose of the laser, pose ∘ mount."""
        if self.mount is None:
            return pose
        return se2.compose(pose, jnp.asarray(self.mount, pose.dtype))


@record
class LaserWorld:
    """A robot that drives among exact walls with a laser; `scan_world` draws a history of it."""

    name: str = static()
    walls: Walls
    laser: Laser
    motion: Motion
    """motion whose noise is on the odometry in the log; the robot drives as the controls say"""
    controls: Float[JaxOrNumPy, "T U"]
    pose: Float[JaxOrNumPy, "3"]
    """pose before the first control"""

    def __post_init__(self) -> None:
        for name in ("controls", "pose"):
            check_field(self, name, as_array)


class LaserHistory(NamedTuple):
    """A history of a `LaserWorld`. Row t: the control that led *to* pose t, and the scan there."""

    pose: Float[Array, "T 3"]
    """true pose of the robot"""
    control: Float[Array, "T U"]
    """control with noise, as the robot records it"""
    beams: Beams
    """with leading T"""

    def __repr__(self) -> str:
        return short_repr(self)


def true_ranges(
    laser: Laser,
    walls: Walls,
    pose: Float[Array, "3"],
    passes: Bool[Array, "B K"] | None = None,
) -> Float[Array, "B"]:
    """The exact ranges [m] of a laser on a robot at a pose, at most max_range.

    passes: mask of the segments that a beam goes through, as through glass; None: it passes none.
    """
    eye = laser.frame(pose)
    return exact_ranges(walls, eye, jnp.asarray(laser.angles, pose.dtype), laser.max_range, passes)


def scan(laser: Laser, walls: Walls, pose: Float[Array, "3"], key: Array) -> Beams:
    """A random scan: exact ranges with N(0, σ²) on those below max_range, less the dropouts.

    A noisy range lies within [0, max_range]. Where walls are of glass, each beam passes each such
    segment with the probability in `Walls.glass`, and meets the wall behind it.
    """
    if walls.glass is None:
        key_noise, key_drop = jax.random.split(key)
        exact = true_ranges(laser, walls, pose)
    else:
        key_noise, key_drop, key_glass = jax.random.split(key, 3)
        share = jnp.asarray(walls.glass, pose.dtype)
        drawn = jax.random.uniform(key_glass, (len(laser.angles), len(share)), pose.dtype)
        exact = true_ranges(laser, walls, pose, drawn < share[None])
    noise = laser.sigma * jax.random.normal(key_noise, exact.shape, exact.dtype)
    noisy = jnp.clip(exact + noise, 0.0, laser.max_range)
    valid = jax.random.uniform(key_drop, exact.shape) >= laser.dropout
    ranges = jnp.where(exact < laser.max_range, noisy, laser.max_range)
    angles = jnp.asarray(laser.angles, exact.dtype)
    return Beams(jnp.where(valid, ranges, 0.0), angles, valid)


def scan_world(world: LaserWorld, key: Array) -> LaserHistory:
    """A random history of a world: its path, odometry and scans; traceable, as `simulate` is."""
    with refusals_of("scan_world"):
        require("world", world, instance_of(LaserWorld))
        require("key", key, prng_key)
    history: LaserHistory = _scan_world(world, key)
    return history


@partial(jax.jit, inline=True)
def _scan_world(world: LaserWorld, key: Array) -> LaserHistory:
    dtype = jnp.result_type(float)
    key_motion, key_scan = jax.random.split(key)
    controls = jnp.asarray(world.controls, dtype)
    start = jnp.asarray(world.pose, dtype)
    poses, logged = drive(world.motion, start, controls, key_motion, "odometry")
    keys = jax.random.split(key_scan, len(poses))
    beams = jax.vmap(lambda pose, k: scan(world.laser, world.walls, pose, k))(poses, keys)
    return LaserHistory(poses, logged, beams)


class Observability(NamedTuple):
    """The information of one scan on the pose (x, y, θ)."""

    information: Float[np.ndarray, "3 3"]
    """J, Fisher's information in units of 1/m², 1/m and 1/rad²"""
    bound: Float[np.ndarray, "3 3"]
    """Cramér-Rao bound J⁻¹: no unbiased estimate has a smaller covariance; with degenerate
    directions the pseudo-inverse, within the directions that the scan determines"""
    directions: Float[np.ndarray, "D 3"]
    """unit motions (dx, dy, dθ) of the pose that change no range"""
    names: tuple[str, ...]
    """text for each direction: a translation with its heading, or a rotation with its centre"""


def scan_information(
    laser: Laser, walls: Walls, pose: ArrayLike, *, tolerance: float = 1e-9
) -> Observability:
    """The Fisher information of a scan about the pose, its bound, and the degenerate directions.

    J = (1 - dropout)/σ² Σ p g gᵀ over beams and the walls that they meet below max_range, g the
    derivative of the exact range by the pose, by automatic differentiation, and p the probability
    that the beam returns from this wall: the product of the shares that pass all nearer walls,
    times the share that does not pass this wall; without glass 1 for the nearest wall. J is the
    expectation over the glass that beams pass. It is exact if the walls that a beam may return from
    lie many σ apart, so that the range tells the wall; else J is too large, and the bound holds.
    Lengths are measured in median ranges when eigenvalues are compared; a direction is degenerate
    below `tolerance` times the largest.

    Censi 2007, "On achievable accuracy for range-finder localization", ICRA.

    Raises ValueError if no beam meets a wall.
    """
    place = np.asarray(pose, np.float64)
    if place.shape != (3,):
        reason = f"expected (x, y, θ), got shape {place.shape}"
        raise InvalidField("pose", reason, owner="scan_information")
    ranges, slopes = (
        np.asarray(part, np.float64) for part in _ranges_and_slopes(laser, walls, place)
    )
    passed = np.zeros(ranges.shape[1])
    passed[: len(walls.segments)] = 0.0 if walls.glass is None else walls.glass
    order = np.argsort(ranges, axis=1)
    reached = np.cumprod(passed[order], axis=1)
    reached = np.concatenate([np.ones((len(ranges), 1)), reached[:, :-1]], axis=1)
    share = np.zeros(ranges.shape)
    np.put_along_axis(share, order, reached * (1 - passed[order]), axis=1)
    met = (share > 0) & (ranges < laser.max_range * (1 - 1e-6))
    if not met.any():
        reason = f"no beam from {place} meets a wall within max_range"
        raise InvalidField("pose", reason, owner="scan_information")
    g = slopes[met]
    dropout, sigma = (float(np.asarray(number)) for number in (laser.dropout, laser.sigma))
    information = (1 - dropout) / sigma**2 * (share[met] * g.T) @ g
    unit = np.array([1.0, 1.0, 1.0 / float(np.median(ranges[met]))])
    values, vectors = np.linalg.eigh(unit[:, None] * information * unit)
    seen = values > tolerance * values[-1]
    inverse = np.where(seen, 1 / np.where(seen, values, 1.0), 0.0)
    scaled = unit[:, None] * vectors
    bound = scaled * inverse @ scaled.T
    free = scaled[:, ~seen].T
    free = free / np.linalg.norm(free, axis=1, keepdims=True)
    return Observability(
        information, bound, free, tuple(_describe(d, place, unit[2]) for d in free)
    )


@partial(jax.jit, inline=True)
def _ranges_and_slopes(laser: Laser, walls: Walls, pose: Array) -> tuple[Array, Array]:
    angles = jnp.asarray(laser.angles, pose.dtype)

    def ranges(pose: Array) -> Array:
        return wall_ranges(walls, laser.frame(pose), angles, laser.max_range)

    return ranges(pose), jax.jacfwd(ranges)(pose)


def _describe(
    direction: Float[np.ndarray, "3"], pose: Float[np.ndarray, "3"], per_length: float
) -> str:
    """The text for a motion: with turn ω a rotation about t + (-dy, dx)/ω, else a translation."""
    dx, dy, turn = direction
    if abs(turn) < 1e-3 * per_length * np.hypot(dx, dy):
        heading = np.degrees(np.arctan2(dy, dx)) % 180
        return f"translation along {heading if heading < 179.95 else 0.0:.1f}°"
    x, y = pose[0] - dy / turn, pose[1] + dx / turn
    x, y = round(x, 2) + 0.0, round(y, 2) + 0.0  # no -0.00
    return f"rotation about ({x:.2f} m, {y:.2f} m)"
