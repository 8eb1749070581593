"""Several sensors on one robot, each with a model, mount, rate and measurement slots.

And the base class of sensors that change some methods of another.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Literal

import jax
import jax.numpy as jnp
from jax import Array

from jaxslam.core._record import field, function_of, record, static
from jaxslam.core._reprs import describe
from jaxslam.core.protocols import Free, Reduced, Sensor
from jaxslam.core.types import Scan
from jaxslam.core.validation import InvalidField, at_least, instance_of, one_of, or_none
from jaxslam.math._arrays import Landmark, Measurement, Point, Pose, Robot, Unmeasured


class Wrapped(Sensor):
    """A sensor that holds another, with whose methods it answers unless it defines them."""

    sensor: Sensor

    @property
    def name(self) -> str:  # type: ignore[override]
        return self.sensor.name

    @property
    def equations(self) -> str:  # type: ignore[override]
        return self.sensor.equations

    @property
    def measurements(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.sensor.measurements

    @property
    def landmark(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.sensor.landmark

    @property
    def robot(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.sensor.robot

    @property
    def free(self) -> Free:  # type: ignore[override]
        return self.sensor.free

    def observe(self, pose: Robot, landmark: Landmark) -> Measurement:
        return self.sensor.observe(pose, landmark)

    def residual(self, z: Measurement, z_hat: Measurement) -> Measurement:
        return self.sensor.residual(z, z_hat)

    def noise_cov(self, z: Measurement) -> Array:
        cov: Array = self.sensor.noise_cov(z)
        return cov

    def invert(self, pose: Robot, z: Measurement, s: Unmeasured) -> Landmark:
        return self.sensor.invert(pose, z, s)

    def position(self, landmark: Landmark) -> Point:
        return self.sensor.position(landmark)

    def embed(self, pose: Pose, point: Point) -> Landmark:
        return self.sensor.embed(pose, point)


def _check_single(sensor: Sensor) -> Sensor:
    if isinstance(sensor, Suite):
        raise ValueError("expected one Sensor, got a Suite")
    single: Sensor = instance_of(Sensor)(sensor)
    return single


@record
class Part:
    """One sensor of a suite. Raises InvalidField on places or an interval below 1."""

    sensor: Sensor = field(check=_check_single)
    places: int = static(check=at_least(1))
    """its measurement slots in a scan; 1 of an absolute sensor"""
    interval: int = static(default=1, check=at_least(1))
    """interval of its measurements in a simulation [steps]; a filter uses only `Scan.valid`"""
    start: int = static(default=0, check=at_least(0))
    """step of its first measurement in a simulation"""
    visible: Callable[[Array, Array], Array] | None = field(
        default=None, check=or_none(function_of("pose", "l"))
    )
    """(pose, l) -> (): its field of view in a simulation; None for that of the scenario"""
    sees: Literal["landmarks", "robots"] = static(
        default="landmarks", check=one_of("landmarks", "robots")
    )
    """what its slots measure in a simulation. A filter of one robot ignores measurements of
    robots (`Status.UNMATCHED`); that of a team uses the tags, and starts no landmark there."""

    def __post_init__(self) -> None:
        if not self.sensor.landmark and self.places != 1:
            reason = f"expected 1 of the absolute sensor {self.sensor.name}, got {self.places}"
            raise InvalidField("places", reason)

    @property
    def absolute(self) -> bool:
        """Whether it is an absolute sensor, which measures the robot and no landmark."""
        return self.sensor.absolute


def _parts(parts: Sequence[Part | tuple[Sensor, int]]) -> tuple[Part, ...]:
    """The check of the parts of a suite: at least one, whose sensors share landmarks."""
    if not isinstance(parts, Sequence):
        raise ValueError(f"expected a list or a tuple, got {describe(parts)}")
    for part in parts:
        if not isinstance(part, Part) and not (isinstance(part, tuple) and len(part) == 2):
            raise ValueError(f"expected a Part or (sensor, places), got {describe(part)}")
    result = tuple(part if isinstance(part, Part) else Part(*part) for part in parts)
    if not result:
        raise ValueError("expected at least one sensor, got none")
    sensors = [part.sensor for part in result if not part.absolute]
    for sensor in sensors[1:]:
        if sensor.landmark != sensors[0].landmark or not sensor.of_points:
            raise ValueError(
                f"expected sensors that share landmarks (x, y), got {sensors[0].landmark} of "
                f"{sensors[0].name} and {sensor.landmark} of {sensor.name}"
            )
    return result


@record
class Suite(Sensor):
    """The sensors of one robot (Solà's loop over sensors), to be used where a `Sensor` is.

    A filter processes the parts one after the other: each corrects by its measurements of known
    landmarks, then starts its new ones, which the next part may correct in the same scan.
    A tag may occur once a part. Absent measurements are slots that are not valid.

        eyes = Suite([(RangeBearing(R, mount=front), 8), Part(Compass(S), 1, interval=10)])
        filter = EkfSlam(motion, eyes, capacity)

    The first slots of a scan are the first part's, the next ones the second's, and so on. Rows of
    z are padded with zeros to the largest measurement. As a `Sensor` it only gives the sizes of
    measurements and landmarks; the models are those of its parts.

    Raises ValueError without parts, on a part of another type, or if several sensors of landmarks
    do not share landmarks (x, y): only a single one may have others.
    """

    parts: tuple[Part, ...] = field(check=_parts)
    """each given as a `Part` or (sensor, places)"""

    @property
    def first(self) -> Sensor:
        """The first sensor of landmarks, whose kind of landmarks all have; or of all."""
        grounded = [part.sensor for part in self.parts if not part.absolute]
        return grounded[0] if grounded else self.parts[0].sensor

    @property
    def places(self) -> tuple[int, ...]:
        """The number of measurement slots of each part."""
        return tuple(part.places for part in self.parts)

    @property
    def name(self) -> str:  # type: ignore[override]
        return " + ".join(part.sensor.name for part in self.parts)

    @property
    def measurements(self) -> tuple[str, ...]:  # type: ignore[override]
        size = max(len(part.sensor.measurements) for part in self.parts)
        return tuple(f"entry {i} of its sensor" for i in range(size))

    @property
    def landmark(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.first.landmark

    @property
    def robot(self) -> tuple[str, ...]:  # type: ignore[override]
        return tuple(dict.fromkeys(name for part in self.parts for name in part.sensor.robot))

    @property
    def carry(self) -> Callable[[Array, Array], Array] | None:
        carry: Callable[[Array, Array], Array] | None = self.first.carry
        return carry

    @property
    def reduced(self) -> Reduced | None:  # type: ignore[override]
        return self.first.reduced

    def scans(self, scan: Scan) -> list[tuple[Sensor | None, Scan]]:
        size = len(self.landmark)
        pairs: list[tuple[Sensor | None, Scan]] = []
        for part, part_scan in zip(self.parts, split_scan(scan, self.places), strict=True):
            if part.sees == "robots":
                pairs.append((None, part_scan))
            else:
                z = part_scan.z[:, : len(part.sensor.measurements)]
                pairs.append((on_ground(part.sensor, size), part_scan._replace(z=z)))
        return pairs

    def position(self, landmark: Landmark) -> Point:
        return self.first.position(landmark)

    def embed(self, pose: Pose, point: Point) -> Landmark:
        return self.first.embed(pose, point)

    def observe(self, pose: Robot, landmark: Landmark) -> Measurement:
        reason = "a suite has no model of its own: call those of its parts"
        raise InvalidField("", reason, owner=type(self).__name__)

    # The other functions of a model are refused by `observe`, whatever it is given.
    def residual(self, z: Measurement, z_hat: Measurement) -> Measurement:
        return self.observe(z, z_hat)

    def noise_cov(self, z: Measurement) -> Array:
        return self.observe(z, z)

    def invert(self, pose: Robot, z: Measurement, s: Unmeasured) -> Landmark:
        return self.observe(pose, z)


def split_scan(scan: Scan, places: Sequence[int]) -> list[Scan]:
    """The scan (M,) divided into the scans of the sensors, in order.

    Raises ValueError unless the scan has as many slots as the sensors together.
    """
    if sum(places) != scan.tag.shape[0]:
        raise InvalidField(
            "places",
            f"expected {sum(places)} measurement slots in a scan, {tuple(places)} by sensor, got "
            f"{scan.tag.shape[0]}",
            owner="Suite",
        )
    ends = list(itertools.accumulate(places))
    return [
        jax.tree.map(lambda leaf, first=end - count, end=end: leaf[first:end], scan)
        for end, count in zip(ends, places, strict=True)
    ]


def on_ground(sensor: Sensor, size: int) -> Sensor:
    """The sensor for landmarks of `size` numbers, of which it uses the first."""
    return sensor if len(sensor.landmark) == size else _OnGround(sensor, size)


def of_robot(sensor: Sensor, state: tuple[str, ...]) -> Sensor:
    """The sensor for a robot of these numbers (`Motion.state`), of which it uses what it asks for.

    The same where the state is a pose. Precondition: the state has what it asks for.
    """
    if len(state) == 3:
        return sensor
    return _OfRobot(sensor, tuple(state.index(name) for name in sensor.robot), state)


@record
class _OfRobot(Wrapped):
    """A sensor of a robot (R,) with more numbers than it uses: the pose, and those of an index."""

    sensor: Sensor
    index: tuple[int, ...] = static()
    state: tuple[str, ...] = static()

    @property
    def absolute(self) -> bool:
        return self.sensor.absolute

    @property
    def carry(self) -> Callable[[Array, Array], Array] | None:
        carry: Callable[[Array, Array], Array] | None = self.sensor.carry
        return carry

    @property
    def reduced(self) -> Reduced | None:  # type: ignore[override]
        reduced = self.sensor.reduced
        if reduced is None:
            return None
        return reduced._replace(sensor=of_robot(reduced.sensor, self.state))

    def observe(self, pose: Robot, landmark: Landmark) -> Measurement:
        return self.sensor.observe(self._own(pose), landmark)

    def invert(self, pose: Robot, z: Measurement, s: Unmeasured) -> Landmark:
        return self.sensor.invert(self._own(pose), z, s)

    def _own(self, robot: Robot) -> Array:
        if not self.index:
            return robot[:3]
        return jnp.concatenate([robot[:3], *[robot[i : i + 1] for i in self.index]])


def conditioned(sensor: Sensor, further: Array) -> Sensor:
    """The sensor of a pose alone, where the k numbers of the robot that it asks for are known."""
    return _Conditioned(sensor, further)


@record
class _Conditioned(Wrapped):
    """A sensor with the numbers (k,) of the robot that it asks for beside the pose."""

    sensor: Sensor
    further: Array
    robot = ()

    def observe(self, pose: Pose, landmark: Landmark) -> Measurement:
        return self.sensor.observe(jnp.concatenate([pose, self.further]), landmark)

    def invert(self, pose: Pose, z: Measurement, s: Unmeasured) -> Landmark:
        return self.sensor.invert(jnp.concatenate([pose, self.further]), z, s)


@record
class _OnGround(Wrapped):
    """A sensor for landmarks of more numbers than it uses.

    A measurement does not depend on the others: an absolute sensor ignores them all, and in a new
    landmark they have zero mean, unit variance and no correlation, as padding.
    """

    sensor: Sensor
    size: int = static()

    @property
    def landmark(self) -> tuple[str, ...]:  # type: ignore[override]
        entries = self.sensor.landmark
        return (*entries, *("-",) * (self.size - len(entries)))

    @property
    def absolute(self) -> bool:
        return self.sensor.absolute

    @property
    def free(self) -> Free:  # type: ignore[override]
        prior, spare = self.sensor.free, self.size - len(self.sensor.landmark)
        mean = jnp.asarray(prior.mean)
        kept = mean.shape[0]
        # The numbers that the sensor does not use: zero mean, unit variance, as padding.
        cov = jnp.eye(kept + spare, dtype=mean.dtype).at[:kept, :kept].set(prior.cov)
        return Free(jnp.concatenate([mean, jnp.zeros(spare, mean.dtype)]), cov)

    def observe(self, pose: Robot, landmark: Landmark) -> Measurement:
        return self.sensor.observe(pose, self._own(landmark))

    def invert(self, pose: Robot, z: Measurement, s: Unmeasured) -> Landmark:
        kept = self.sensor.free.mean.shape[0]
        return jnp.concatenate([self.sensor.invert(pose, z, s[:kept]), s[kept:]])

    def position(self, landmark: Landmark) -> Point:
        return self.sensor.position(self._own(landmark))

    def embed(self, pose: Pose, point: Point) -> Landmark:
        landmark = self.sensor.embed(pose, point)
        return jnp.concatenate([landmark, jnp.zeros(self.size - len(landmark), pose.dtype)])

    def _own(self, landmark: Landmark) -> Array:
        return landmark[: len(self.sensor.landmark)]
