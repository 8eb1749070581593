"""Several sensors on one robot, each with its own model, mount, rate and measurement slots."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, NoReturn

import jax
import jax.numpy as jnp
from jax import Array

from jaxslam.math.arrays import Landmark, Measurement, Point, Pose, Unmeasured
from jaxslam.protocols import Free, Sensor
from jaxslam.types import Scan
from jaxslam.validation.numbers import check_count


@dataclass(frozen=True, eq=False)
class Part:
    """One sensor of a suite. Raises ValueError on places or every below 1, or an invalid start."""

    sensor: Sensor
    places: int
    """its measurement slots in a scan; 1 of an absolute sensor"""
    every: int = 1
    """in a simulation it measures every so many steps,"""
    start: int = 0
    """beginning with this one; a filter uses `Scan.valid` alone"""
    visible: Callable[[Array, Array], Array] | None = None
    """(pose, l) -> (): its field of view in a simulation; None for that of the scenario"""
    sees: Literal["landmarks", "robots"] = "landmarks"
    """what its slots measure in a simulation. A filter of one robot ignores measurements of
    robots (`Status.UNMATCHED`); that of a team uses the tags, and starts no landmark there."""

    def __post_init__(self) -> None:
        if not isinstance(self.sensor, Sensor) or isinstance(self.sensor, Suite):
            raise ValueError(f"suite: expected one Sensor in each Part, got {self.sensor!r}")
        check_count(f"suite: places of {self.sensor.name}", self.places)
        check_count(f"suite: every of {self.sensor.name}", self.every)
        if type(self.start) is not int or self.start < 0:
            raise ValueError(f"suite: expected a start of at least 0, got {self.start!r}")
        if self.sees not in ("landmarks", "robots"):
            raise ValueError(f'suite: expected sees "landmarks" or "robots", got {self.sees!r}')
        if not self.sensor.landmark and self.places != 1:
            raise ValueError(
                f"suite: expected places=1 of the absolute sensor {self.sensor.name}, got "
                f"{self.places}"
            )

    @property
    def absolute(self) -> bool:
        """Whether it is an absolute sensor, which measures the robot and no landmark."""
        return not self.sensor.landmark


@dataclass(frozen=True, eq=False)
class Suite(Sensor):
    """A set of sensors with separate measurement slots; made by `suite`.

    The first slots of a scan are the first part's, the next ones the second's, and so on. Rows of
    z are padded with zeros to the largest measurement. As a `Sensor` it only gives the sizes of
    measurements and landmarks; the models are those of its parts.
    """

    parts: tuple[Part, ...] = ()

    @property
    def places(self) -> tuple[int, ...]:
        """The number of measurement slots of each part."""
        return tuple(part.places for part in self.parts)


def suite(*parts: Part | tuple[Sensor, int]) -> Suite:
    """The sensors of one robot (Solà's loop over sensors), to be used where a `Sensor` is.

    A filter processes the parts one after the other: each corrects by its measurements of known
    landmarks, then starts its new ones, which the next part may correct in the same scan.
    A tag may occur once a part. Absent measurements are slots that are not valid.

        eyes = suite((range_bearing(R, mount=front), 8), Part(compass(S), 1, every=10))
        filter = ekf_slam(motion, eyes, capacity)

    Args:
        parts: a `Part`, or (sensor, places), each.
    Raises:
        ValueError: without parts, on a part of another type, or if several sensors of landmarks do
            not share landmarks (x, y): only a single one may have others.
    """
    made = tuple(part if isinstance(part, Part) else _part(part) for part in parts)
    if not made:
        raise ValueError("suite: expected at least one sensor")
    grounded = [part.sensor for part in made if not part.absolute]
    first = grounded[0] if grounded else made[0].sensor
    for sensor in grounded[1:]:
        if sensor.landmark != first.landmark or not sensor.of_points:
            raise ValueError(
                f"suite: expected sensors that share landmarks (x, y), got {first.landmark} of "
                f"{first.name} and {sensor.landmark} of {sensor.name}"
            )
    size = max(len(part.sensor.measurements) for part in made)

    def not_one(*_: object) -> NoReturn:
        raise ValueError("suite: a suite has no model of its own: call those of suite.parts")

    return Suite(
        name=" + ".join(part.sensor.name for part in made),
        measurements=tuple(f"entry {i} of its sensor" for i in range(size)),
        landmark=first.landmark,
        observe=not_one,
        residual=not_one,
        noise_cov=not_one,
        invert=not_one,
        position=first.position,
        embed=first.embed,
        carry=first.carry,
        reduced=first.reduced,
        parts=made,
    )


def _part(given: object) -> Part:
    if not isinstance(given, tuple) or len(given) != 2:
        raise ValueError(f"suite: expected a Part or (sensor, places), got {given!r}")
    return Part(*given)


def split_scan(scan: Scan, places: Sequence[int]) -> list[Scan]:
    """The scan (M,) divided into the scans of the sensors, in order.

    Raises ValueError unless the scan has as many slots as the sensors together.
    """
    if sum(places) != scan.tag.shape[0]:
        raise ValueError(
            f"suite: expected {sum(places)} measurement slots in a scan, {tuple(places)} by "
            f"sensor, got {scan.tag.shape[0]}"
        )
    ends = list(itertools.accumulate(places))
    return [
        jax.tree.map(lambda leaf, first=end - count, end=end: leaf[first:end], scan)
        for end, count in zip(ends, places, strict=True)
    ]


def on_ground(sensor: Sensor, size: int) -> Sensor:
    """The sensor for landmarks of `size` numbers, of which it uses the first.

    A measurement does not depend on the others: an absolute sensor ignores them all, and in a new
    landmark they have zero mean, unit variance and no correlation, as padding.
    """
    own, spare = len(sensor.landmark), size - len(sensor.landmark)
    if spare == 0:
        return sensor
    kept = sensor.free.mean.shape[0]

    def invert(pose: Pose, z: Measurement, s: Unmeasured) -> Landmark:
        return jnp.concatenate([sensor.invert(pose, z, s[:kept]), s[kept:]])

    def embed(pose: Pose, point: Point) -> Landmark:
        return jnp.concatenate([sensor.embed(pose, point), jnp.zeros(spare, pose.dtype)])

    dtype = jnp.asarray(sensor.free.mean).dtype
    free = Free(
        jnp.concatenate([sensor.free.mean, jnp.zeros(spare, dtype)]),
        jnp.eye(kept + spare, dtype=dtype).at[:kept, :kept].set(sensor.free.cov),
    )
    return Sensor(
        name=sensor.name,
        measurements=sensor.measurements,
        landmark=(*sensor.landmark, *("-",) * spare),
        observe=lambda pose, landmark: sensor.observe(pose, landmark[:own]),
        residual=sensor.residual,
        noise_cov=sensor.noise_cov,
        invert=invert,
        position=lambda landmark: sensor.position(landmark[:own]),
        embed=embed,
        free=free,
    )
