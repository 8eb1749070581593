"""Simulated scans: fields of view, and noisy measurements along a path."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxslam.core._numbers import is_concrete
from jaxslam.core._record import record
from jaxslam.core.protocols import Sensor
from jaxslam.core.types import Scan
from jaxslam.core.validation import InvalidField
from jaxslam.math._arrays import Landmark, Number, Pose
from jaxslam.math._linalg import root_psd
from jaxslam.sensors._suite import Part, of_robot

Visible = Callable[[jax.Array, jax.Array], jax.Array]
"""(pose, l) -> () bool: whether a sensor reports the landmark from there."""


def everywhere(pose: Float[Array, "3"], landmark: Float[Array, "L"]) -> Bool[Array, ""]:
    """The field of view in which every landmark is seen from every pose."""
    return jnp.asarray(True)


@record
class BetweenRanges:
    """A field of view all around, from nearest to farthest metres (both excluded).

    Raises ValueError unless 0 <= nearest < farthest.
    """

    nearest: Number
    farthest: Number

    def __post_init__(self) -> None:
        if is_concrete(self.nearest, self.farthest) and not np.all(
            (np.asarray(self.nearest) >= 0) & (self.nearest < np.asarray(self.farthest))
        ):
            raise InvalidField(
                "", f"expected 0 <= nearest < farthest, got {self.nearest} and {self.farthest}"
            )

    def __call__(self, pose: Pose, landmark: Landmark) -> jax.Array:
        squared = jnp.sum((landmark[:2] - pose[:2]) ** 2)
        nearest, farthest = (jnp.asarray(x, pose.dtype) for x in (self.nearest, self.farthest))
        return (squared > nearest**2) & (squared < farthest**2)


def sensor_scans(
    sensor: Sensor,
    visible: Visible,
    places: int,
    poses: Float[Array, "T R"],
    targets: Float[Array, "*time C L"],
    on: Bool[Array, "T"] | None,
    key: Array,
) -> tuple[Scan, Int[Array, "T"]]:
    """The scans (T, …) of one sensor, and how many targets in view had no measurement slot.

    poses: with the further numbers of the robot that the sensor takes. targets: (C, L), or
    (T, C, L) where they move; tags are their rows. on: when the sensor measures, None for always.
    """
    count = targets.shape[-2]
    places = min(places, count)
    by_time = None if targets.ndim == 2 else 0
    viewpoints = poses if poses.shape[1] == 3 else poses[:, :3]
    seen = jax.vmap(jax.vmap(visible, (None, 0)), (0, by_time))(viewpoints, targets)
    if seen.shape != (len(poses), count) or seen.dtype != bool:
        got = f"{seen.dtype} of shape {seen.shape[2:]}"
        raise InvalidField("visible", f"expected a bool for each pose and landmark, got {got}")
    if on is not None:
        seen = seen & on[:, None]
    if places < count:
        tag = jnp.argsort(~seen, axis=1, stable=True)[:, :places]
        valid = jnp.take_along_axis(seen, tag, axis=1)
    else:
        tag, valid = jnp.broadcast_to(jnp.arange(count), seen.shape), seen
    keys = jax.random.split(key, poses.shape[0])

    of_pose = partial(noisy_scan, sensor)
    scan = jax.vmap(of_pose, (0, by_time, 0, 0, 0))(poses, targets, tag, valid, keys)
    return scan, seen.sum(axis=1) - valid.sum(axis=1)


def noisy_scan(
    sensor: Sensor,
    pose: Float[Array, "R"],
    targets: Float[Array, "C L"],
    tag: Int[Array, "M"],
    valid: Bool[Array, "M"],
    key: Array,
) -> Scan:
    """The scan of a sensor at a pose, with drawn noise. tag: rows of the targets it measures.

    pose: with the further numbers of the robot that the sensor takes.
    """
    exact = jax.vmap(sensor.observe, (None, 0))(pose, targets[jnp.maximum(tag, 0)])
    noise = jax.vmap(draw_gaussian)(jax.vmap(sensor.noise_cov)(exact), normals_like(key, exact))
    z = jax.vmap(sensor.residual)(exact + noise, jnp.zeros_like(exact))
    return Scan(
        z=jnp.where(valid[:, None], z, 0.0),
        tag=jnp.where(valid, tag, -1).astype(jnp.int32),
        valid=valid,
    )


def part_scan(
    part: Part,
    state: tuple[str, ...],
    visible: Visible,
    poses: Float[Array, "T R"],
    targets: Float[Array, "*time C L"],
    tags: Int[Array, "C"],
    key: Array,
) -> tuple[Scan, Int[Array, "T"]]:
    """The `sensor_scans` of one part of a suite, in its measurement slots and at its rate.

    state: what the rows of poses (T, R) hold, as `Motion.state`. tags: of the targets. An absolute
    sensor has no tag. Without targets nothing is measured.
    """
    step = jnp.arange(poses.shape[0])
    if targets.shape[-2] == 0:
        z = jnp.zeros((len(poses), part.places, len(part.sensor.measurements)), poses.dtype)
        none = jnp.zeros(z.shape[:2], bool)
        return Scan(z, jnp.full(none.shape, -1, jnp.int32), none), jnp.zeros_like(step)
    sensor = of_robot(part.sensor, state)
    on = (step >= part.start) & ((step - part.start) % part.interval == 0)
    if part.absolute:
        nothing = jnp.zeros((1, 0), poses.dtype)
        scan, missed = sensor_scans(sensor, everywhere, 1, poses, nothing, on, key)
        return scan._replace(tag=jnp.full_like(scan.tag, -1)), missed
    field = visible if part.visible is None else part.visible
    scan, missed = sensor_scans(sensor, field, part.places, poses, targets, on, key)
    tag = jnp.where(scan.valid, tags[jnp.maximum(scan.tag, 0)], -1).astype(jnp.int32)
    spare = part.places - tag.shape[1]
    if spare > 0:  # more slots than there are targets
        scan = Scan(
            z=jnp.pad(scan.z, [(0, 0), (0, spare), (0, 0)]),
            tag=jnp.pad(tag, [(0, 0), (0, spare)], constant_values=-1),
            valid=jnp.pad(scan.valid, [(0, 0), (0, spare)]),
        )
        return scan, missed
    return scan._replace(tag=tag), missed


def side_by_side(scans: list[tuple[Scan, Array]], size_z: int) -> tuple[Scan, Int[Array, "T"]]:
    """The scans of several sensors as one, z padded with zeros to size_z; and how many targets had
    no measurement slot."""
    z = [jnp.pad(s.z, [(0, 0), (0, 0), (0, size_z - s.z.shape[2])]) for s, _ in scans]
    scan = Scan(
        z=jnp.concatenate(z, axis=1),
        tag=jnp.concatenate([s.tag for s, _ in scans], axis=1),
        valid=jnp.concatenate([s.valid for s, _ in scans], axis=1),
    )
    return scan, jnp.stack([missed for _, missed in scans]).sum(axis=0)


def normals_like(key: Array, like: Array) -> Array:
    """Standard normal numbers in the shape of `like`."""
    return jax.random.normal(key, like.shape, like.dtype)


def draw_gaussian(cov: Float[Array, "W W"], normal: Float[Array, "W"]) -> Float[Array, "W"]:
    """A draw of N(0, cov) from standard normals; cov may be singular or zero."""
    return root_psd(cov) @ normal
