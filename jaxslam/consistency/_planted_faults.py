"""What errors of the models do to the innovations of a log: faults planted in its noise-free twin.

A twin without noise has innovations of linearization alone. With a small fault in it, as clocks
that differ or a scanner that is turned, the innovations of the same filter change by the fault's
shape b. An innovation that is b a + noise of covariance S has a most likely a,

    â = Σ bᵀ S⁻¹ ν / Σ bᵀ S⁻¹ b,

which is the score test of the constant (Rao 1948) and the first step of its fit.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxslam.core.logs._tables import INTERVAL, split_unit
from jaxslam.core.protocols import Motion
from jaxslam.core.types import Log, Scan, Truth
from jaxslam.math import se2
from jaxslam.sensors._suite import of_robot
from jaxslam.simulation._twin import Twin

PARTS = 20
"""Parts of the log, in time, in each of which a slip is planted."""

WINDOWS = PARTS - 1
"""Tenths of the log, each of two successive parts, in each of which a slip is looked for."""


class Amounts(NamedTuple):
    """The amount of each fault in a log; 0 is none."""

    delay: Float[Array, ""]
    """[s] by which measurements are stamped later than they happened"""
    turned: Float[Array, ""]
    """[rad] by which the sensor is turned, counter-clockwise"""
    longer: Float[Array, ""]
    """share by which distances are measured too long"""
    offset: Float[Array, ""]
    """[m] by which ranges are measured too long"""
    turning: Float[Array, ""]
    """share by which turns are recorded too large"""
    bending: Float[Array, ""]
    """[rad/m] turn that is recorded for each metre of travel, beside the true one"""
    slip: Float[Array, "T"]
    """share by which travel is recorded too long, in each row"""


class Fault(NamedTuple):
    """A fault, what it is planted with, and what it points to."""

    name: str
    """a field of `Amounts`"""
    amount: float
    """small, so that its effect is linear"""
    unit: str
    scale: float
    """by which an amount is multiplied to be shown in that unit"""
    meaning: str
    """a phrase, with the amount in place of {}"""
    remedy: str


_FAULTS = (
    Fault(
        "delay",
        1e-3,
        "s",
        1.0,
        "measurements are stamped {} late",
        "a delay: jaxslam fit --calibrate delay",
    ),
    Fault(
        "turned",
        1e-3,
        "°",
        float(np.rad2deg(1.0)),
        "the sensor is turned by {}, or the robot drives at that angle",
        "the mount: jaxslam fit --calibrate mount, or heading",
    ),
    Fault(
        "longer",
        1e-3,
        "%",
        100.0,
        "distances are measured {} too long, or travel is recorded that much too short",
        "a scale: jaxslam fit --calibrate range, or scale",
    ),
    Fault(
        "offset",
        1e-3,
        "m",
        1.0,
        "ranges are measured {} too long",
        "an offset: jaxslam fit --calibrate range",
    ),
    Fault(
        "turning",
        1e-3,
        "%",
        100.0,
        "turns are recorded {} too large",
        "the scale of the odometry: jaxslam fit --calibrate scale",
    ),
    Fault(
        "bending",
        1e-4,
        "rad/m",
        1.0,
        "the odometry records a turn of {} of travel that is none",
        "unequal wheels: jaxslam fit --calibrate wheels",
    ),
)
_SLIP = Fault(
    "slip",
    1e-3,
    "%",
    100.0,
    "travel is recorded {} too long",
    "slipping wheels, or a push, in that time: odometry noise that grows there",
)


class Columns(NamedTuple):
    """The columns of controls and measurements that faults change, as masks."""

    travel: tuple[bool, ...]
    turn: tuple[bool, ...]
    distance: tuple[bool, ...]
    ranges: tuple[bool, ...]
    bearing: tuple[bool, ...]
    cartesian: bool
    """whether the measurement is a position in the sensor's frame"""


def columns_of(world: Twin) -> Columns:
    """The columns of a world's controls and measurements, by their units and names."""
    controls = [split_unit(name)[1] for name in world.motion.controls]
    names, units = zip(*map(split_unit, world.sensor.measurements), strict=True)
    distance = tuple(unit == "m" for unit in units)
    return Columns(
        travel=tuple(unit in ("m", "m/s") for unit in controls),
        turn=tuple(unit in ("rad", "rad/s") for unit in controls),
        distance=distance,
        ranges=tuple(name == "range" for name in names),
        bearing=tuple(name == "bearing" for name in names),
        cartesian=names[:2] == ("ahead", "left"),
    )


def faults_of(world: Twin) -> tuple[list[Fault], bool]:
    """The faults that a world's models can have, and whether its travel can slip."""
    columns = columns_of(world)
    has_travel, has_turn = any(columns.travel), any(columns.turn)
    has_time = bool(np.ptp(np.asarray(world.time)) > 0)
    possible = {
        "delay": has_time,
        "turned": any(columns.bearing) or columns.cartesian,
        "longer": any(columns.distance) and has_travel,
        "offset": any(columns.ranges),
        "turning": has_turn,
        "bending": has_turn and has_travel,
    }
    return [fault for fault in _FAULTS if possible[fault.name]], has_travel


_SMOOTHED = 2
"""Rows on either side over which the odometry is averaged: its noise would else correlate with the
innovations that it causes, and so would what is planted in proportion to it."""


def averaged_controls(
    world: Twin,
) -> tuple[Float[np.ndarray, "T U"], Float[np.ndarray, "T"]]:
    """The controls of the log, means over some rows about each, and the interval of each row.

    Not those of the smoothed path, which holds noises that were found in the same innovations.
    """
    controls, time = np.asarray(world.controls, np.float64), np.asarray(world.time, np.float64)
    names = world.motion.controls
    interval = np.diff(time, prepend=2 * time[0] - time[min(1, len(time) - 1)])
    if INTERVAL in names:
        interval = controls[:, names.index(INTERVAL)]
    rates = np.array([(split_unit(name)[1] or "").endswith("/s") for name in names])
    moved = np.where(rates, controls * interval[:, None], controls)
    total = np.cumsum(np.column_stack([moved, interval]), axis=0)
    total = np.concatenate([np.zeros((1, total.shape[1])), total])
    rows = np.arange(len(controls))
    high = np.minimum(rows + _SMOOTHED + 1, len(controls))
    change = total[high] - total[np.maximum(rows - _SMOOTHED, 0)]
    lasts = change[:, -1:] > 0
    rate = np.where(lasts, change[:, :-1] / np.where(lasts, change[:, -1:], 1.0), 0.0)
    kept = np.array([name == INTERVAL for name in names])
    mean = np.where(rates, rate, rate * interval[:, None])
    return np.where(kept, controls, mean), interval


def body_rates(world: Twin) -> Float[np.ndarray, "T 3"]:
    """Speed ahead and to the left [m/s], and turn rate [rad/s], in each row, by the odometry."""
    controls, interval = averaged_controls(world)
    dtype = jnp.result_type(float)
    origin = jnp.asarray(world.pose, dtype).at[:3].set(0)
    moves = jax.device_get(_moves(world.motion, origin, controls.astype(dtype)))
    lasts = interval[:, None] > 0
    return np.where(lasts, np.asarray(moves, np.float64) / np.where(lasts, interval[:, None], 1), 0)


@jax.jit
def _moves(
    motion: Motion, origin: Float[Array, "R"], controls: Float[Array, "T U"]
) -> Float[Array, "T 3"]:
    """The nominal motion of each row, in the robot's frame. origin: a robot there."""
    still = jnp.zeros(len(motion.noises), controls.dtype)
    return jax.vmap(lambda u: motion.step(origin, u, still)[:3])(controls)


def planted_logs(world: Twin, faults: Sequence[Fault], slips: bool) -> tuple[Truth, Log]:
    """The noise-free truth, and the logs (1 + F, …): without a fault, with each, with each slip."""
    dtype, steps = jnp.result_type(float), world.steps
    count = 1 + len(faults) + PARTS * slips
    none: PyTree = {name: np.zeros(count, dtype) for name in Amounts._fields}
    none["slip"] = np.zeros((count, steps), dtype)
    for i, fault in enumerate(faults):
        none[fault.name][1 + i] = fault.amount
    for k in range(PARTS * slips):
        none["slip"][1 + len(faults) + k, _rows(steps, k, k + 1)] = _SLIP.amount
    nominal = averaged_controls(world)[0].astype(dtype), body_rates(world).astype(dtype)
    truth, logs = _plant(world, columns_of(world), nominal, Amounts(**none))
    return truth, logs


def window_rows(steps: int, k: int) -> slice:
    """The rows of tenth k of `WINDOWS`."""
    return _rows(steps, k, k + 2)


def _rows(steps: int, first: int, last: int) -> slice:
    """The rows from part `first` to part `last` of `PARTS`, that excluded."""
    edges = np.linspace(0, steps, PARTS + 1).round().astype(int)
    return slice(int(edges[first]), int(edges[last]))


@partial(jax.jit, static_argnames="columns")
def _plant(
    world: Twin, columns: Columns, nominal: tuple[Array, Array], amounts: Amounts
) -> tuple[Truth, Log]:
    """The noise-free truth, and a log for each of a stack of amounts.

    nominal: (T, U) controls and (T, 3) rates of the robot, by the odometry alone.
    """
    dtype = amounts.delay.dtype
    start = jnp.asarray(world.pose, dtype)
    path, logged = world.drive(start, jnp.zeros_like(jnp.asarray(world.noise, dtype)))
    landmarks, (controls, twist) = jnp.asarray(world.landmarks, dtype), nominal
    seen = jnp.asarray(world.seen, jnp.int32)
    sensor = of_robot(world.sensor, world.motion.state)
    travel, turn, distance, ranges, bearing = (jnp.asarray(part, dtype) for part in columns[:5])

    def log_with(amount: Amounts) -> Log:
        # Where the robot was when it measured.
        back = jax.vmap(se2.compose)(path[:, :3], -amount.delay * twist)
        poses = path.at[:, :3].set(back)

        def measure(pose: Array, row: Array) -> Array:
            z = sensor.observe(pose, landmarks[jnp.maximum(row, 0)])
            if columns.cartesian:
                ahead, left = se2.to_frame(
                    jnp.stack([0.0 * z[0], 0.0 * z[0], amount.turned]), z[:2]
                )
                z = z.at[:2].set(jnp.stack([ahead, left]))
            z = z * (1 + amount.longer * distance) + amount.offset * ranges
            z = z - amount.turned * bearing
            residual: Array = sensor.residual(z, jnp.zeros_like(z))
            return residual

        z = jax.vmap(jax.vmap(measure, (None, 0)))(poses, seen)
        scan = Scan(jnp.where((seen >= 0)[..., None], z, 0.0), seen, seen >= 0)
        # The first column of travel and of turn; a left increment has no part in the bending.
        first_travel, first_turn = (part * (jnp.cumsum(part) == 1) for part in (travel, turn))
        scales = amount.slip[:, None] * travel[None] + amount.turning * turn[None]
        bent = amount.bending * (controls @ first_travel)[:, None] * first_turn[None]
        return Log(logged + controls * scales + bent, scan)

    missed = jnp.zeros(len(path), jnp.int32)
    further = None if path.shape[1] == 3 else path[:, 3:]
    truth = Truth(path[:, :3], landmarks, missed, start, further=further)
    if world.associates or world.spurious is not None:
        truth = truth._replace(origin=seen)
    return truth, jax.vmap(log_with)(amounts)


class Shape(NamedTuple):
    """What a fault does to the innovations, ready to be compared with those of a run."""

    fault: Fault
    weights: Float[np.ndarray, "T M Z"]
    """S⁻¹ b"""
    information: float
    """Σ bᵀ S⁻¹ b"""

    def amount(self, innovation: Float[np.ndarray, "T M Z"]) -> float:
        """â of the innovations of a run, 0 where it fused nothing."""
        return float(np.sum(self.weights * innovation) / self.information)


def shapes_of(
    faults: Sequence[Fault], slips: bool, innovations: np.ndarray, covs: np.ndarray
) -> tuple[list[Shape], list[Shape]]:
    """The shapes of the faults, and of the slips in each part of the log; those without information
    are left out.

    Args:
        innovations: (1 + F, T, M, Z) of the filter over `planted_logs`, 0 where it fused nothing.
        covs: (T, M, Z, Z) S of the run without a fault.
    """
    fused = np.diagonal(covs, axis1=-2, axis2=-1).all(axis=-1)
    inverse = np.zeros_like(covs)
    inverse[fused] = np.linalg.inv(covs[fused])

    def shape_of(fault: Fault, change: np.ndarray) -> Shape:
        change = np.where(fused[..., None], change, 0.0) / fault.amount
        weights = np.einsum("tmij,tmj->tmi", inverse, change)
        return Shape(fault, weights, float(np.sum(weights * change)))

    changes = innovations[1:] - innovations[0]
    parts = changes[len(faults) :]
    if slips:
        # The log of a larger world is one of travel that is recorded too short. Its shape by the
        # odometry alone; that of longer ranges holds the travel of the smoothed path, whose noise
        # was found in the same innovations.
        shorter = -parts.sum(axis=0)
        changes = [
            shorter if fault.name == "longer" else change
            for fault, change in zip(faults, changes, strict=False)
        ]
    of_faults = [shape_of(*pair) for pair in zip(faults, changes, strict=False)]
    # To first order a slip of two parts does what one in each does.
    of_slips = [shape_of(_SLIP, parts[k] + parts[k + 1]) for k in range(WINDOWS * slips)]
    return (
        [shape for shape in of_faults if shape.information > 0],
        of_slips if all(shape.information > 0 for shape in of_slips) else [],
    )
