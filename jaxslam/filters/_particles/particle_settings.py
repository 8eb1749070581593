"""The settings of the particle filters, made of their fields, and the checks of these."""

from dataclasses import dataclass
from typing import Any

from jax import Array
from numpy.typing import ArrayLike

from jaxslam.core import _validation as validation
from jaxslam.core._numbers import gate_quantile
from jaxslam.core._record import hold_function
from jaxslam.core.protocols import Associate, Life, Sensor
from jaxslam.filters._known_map import map_tags
from jaxslam.math._arrays import Number
from jaxslam.math.stats import chi2_quantile
from jaxslam.sensors._suite import Suite

# The probability that a measurement of a landmark lies within d², without a gate.
_NEAR = 0.99


@dataclass(frozen=True, eq=False)
class _AssociationSettings:
    """The association method, gate and new-landmark options of one sensor."""

    sensor: Sensor
    associate: Associate
    gate: Number | None

    @property
    def gamma(self) -> Number | None:
        """The largest d² within the gate; None without one."""
        return gate_quantile(self.gate, len(self.sensor.measurements))

    @property
    def unmatched_distance(self) -> Number:
        """The d² assigned to a measurement without a landmark: γ, or that of a gate of `_NEAR`."""
        near = _NEAR if self.gate is None else self.gate
        return chi2_quantile(near, len(self.sensor.measurements))


@dataclass(frozen=True, eq=False)
class ParticleMapSettings(_AssociationSettings):
    """The settings of one particle's map update, of `FastSlam` and `Mapping`."""

    quota: int | None
    """new landmarks a scan at the most"""
    life: Life | None


@dataclass(frozen=True, eq=False)
class KnownMapSensor(_AssociationSettings):
    """One sensor in a known map, for the weights of `particle_localization`."""

    landmarks: ArrayLike
    """(N, L)"""
    tags: Array
    """(N,) int32"""
    measured: int | None
    """measurement slots M of the sensor in a scan; None for all"""
    ignored: bool
    """it measures other robots, and is ignored"""


def particle_map_settings(filter: Any) -> ParticleMapSettings:
    """The settings of a filter's map update, from its fields."""
    return ParticleMapSettings(
        filter.sensor, filter.associate, filter.gate, filter.births, filter.life
    )


def check_particle_map(filter: Any) -> None:
    """Check the fields of `particle_map_settings` in a filter's `__post_init__`; ValueError, which
    begins with its class, on invalid ones."""
    name, sensor = type(filter).__name__, filter.sensor
    validation.check_parts(name, associate=filter.associate, life=filter.life)
    hold_function(filter, "associate", "prediction, scan")
    validation.check_count(f"{name}: capacity", filter.capacity)
    if filter.births is not None:
        validation.check_count(f"{name}: births", filter.births)
    validation.check_gate(name, filter.gate)
    if isinstance(sensor, Suite) or not sensor.landmark or sensor.reduced is not None:
        raise ValueError(
            f"{name}: expected one sensor of landmarks, not a suite, an absolute sensor or "
            f"landmarks that are converted to points, got {sensor.name}"
        )


def known_map_sensors(filter: Any) -> tuple[KnownMapSensor, ...]:
    """The sensors of a suite, or the single sensor, in a known map, from a filter's fields."""
    tags = map_tags(filter)

    def one(sensor: Sensor, measured: int | None, ignored: bool) -> KnownMapSensor:
        return KnownMapSensor(
            sensor, filter.associate, filter.gate, filter.landmarks, tags, measured, ignored
        )

    if not isinstance(filter.sensor, Suite):
        return (one(filter.sensor, None, False),)
    return tuple(
        one(part.sensor, part.places, part.sees == "robots") for part in filter.sensor.parts
    )


def check_resampling(filter: Any) -> None:
    """Check the fields resample and threshold in a filter's `__post_init__`."""
    hold_function(filter, "resample", "log_weights, key")
    threshold = filter.threshold
    if validation.is_concrete(threshold) and not 0 <= threshold <= 1:
        name = type(filter).__name__
        raise ValueError(f"{name}: expected a threshold from 0 to 1, got {threshold}")
