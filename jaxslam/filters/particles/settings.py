"""The settings of the particle filters, created and validated by the factories."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from jaxslam import validation
from jaxslam.association.known import known as known_association
from jaxslam.filters.particles.states.region import Region
from jaxslam.math.stats import chi2_quantile
from jaxslam.protocols import Associate, Differentiable, Life, Motion, Resample, Sensor
from jaxslam.sensors.suite import Suite

# The probability that a measurement of a landmark lies within d², where there is no gate.
_NEAR = 0.99

# The default least number of particles.
_LEAST = 50


@dataclass(frozen=True, eq=False)
class AssociationSettings:
    """The association method, gate and new-landmark options of one sensor."""

    sensor: Sensor
    associate: Associate
    gate: float | None

    @property
    def unmatched_distance(self) -> float:
        """The d² assigned to a measurement without a landmark: the gate, or a high quantile."""
        if self.gate is not None:
            return self.gate
        return chi2_quantile(_NEAR, len(self.sensor.measurements))


@dataclass(frozen=True, eq=False)
class ParticleMapSettings(AssociationSettings):
    """The settings of one particle's map update, of `fastslam` and `mapping`."""

    quota: int | None
    """new landmarks a scan at the most"""
    life: Life | None


@dataclass(frozen=True, eq=False)
class KnownMapSensor(AssociationSettings):
    """One sensor in a known map, for the weights of `particle_localization`."""

    landmarks: ArrayLike
    """(N, L)"""
    tags: np.ndarray
    """(N,) int32"""
    measured: int | None
    """measurement slots M of a scan that are its own; None for all"""
    ignored: bool
    """it measures other robots, and is ignored"""


@dataclass(frozen=True, eq=False)
class MonteCarloSettings:
    """The settings of particles in a known map: origin, number, resampling and recovery.

    Raises ValueError, which begins with the filter's name, on invalid numbers.
    """

    name: str
    motion: Motion
    particles: int
    region: Region | None
    """where the robot may be"""
    start: Literal["gaussian", "uniform"]
    resample: Resample | Differentiable
    threshold: float
    bins: tuple[float, float, float]
    error: float
    confidence: float
    least: int
    rates: tuple[float, float] | None
    """of the long-term and of the short-term average"""
    slack: float

    def __post_init__(self) -> None:
        name, bins, rates = self.name, self.bins, self.rates
        check_resampling(name, self.resample, self.threshold)
        if self.start not in ("gaussian", "uniform"):
            raise ValueError(f'{name}: expected start "gaussian" or "uniform", got {self.start!r}')
        if np.shape(bins) != (3,) or not all(np.isfinite(b) and b > 0 for b in bins):
            raise ValueError(f"{name}: expected bins of three sizes above 0, got {bins!r}")
        if not self.error > 0:
            raise ValueError(f"{name}: expected an error above 0, got {self.error}")
        if not 0 < self.confidence < 1:
            raise ValueError(
                f"{name}: expected a confidence between 0 and 1, got {self.confidence}"
            )
        if validation.is_concrete(self.slack) and not self.slack > 0:
            raise ValueError(f"{name}: expected a slack above 0, got {self.slack}")
        if rates is not None and not (np.shape(rates) == (2,) and 0 < rates[0] <= rates[1] <= 1):
            raise ValueError(
                f"{name}: expected forget = (slow, fast) with 0 < slow <= fast <= 1, got {rates!r}"
            )

    @property
    def injects(self) -> bool:
        """Whether recovery injects particles from the whole region."""
        return self.region is not None and self.rates is not None


def particle_map_settings(
    name: str,
    sensor: Sensor,
    capacity: int,
    *,
    associate: Associate | None,
    gate: float | None,
    births: int | None,
    life: Life | None,
) -> ParticleMapSettings:
    """The settings; ValueError, which begins with a filter's name, on invalid ones."""
    validation.check_parts(name, associate=associate)
    validation.check_count(f"{name}: capacity", capacity)
    if births is not None:
        validation.check_count(f"{name}: births", births)
    if life is not None and not isinstance(life, Life):
        raise ValueError(
            f"{name}: expected life to be a Life, as from life.existence, got {life!r}"
        )
    validation.check_gate(name, gate)
    if isinstance(sensor, Suite) or not sensor.landmark or sensor.reduced is not None:
        raise ValueError(
            f"{name}: expected one sensor of landmarks, not a suite, an absolute sensor or "
            f"landmarks that are converted to points, got {sensor.name}"
        )
    return ParticleMapSettings(sensor, associate or known_association(), gate, births, life)


def known_map_sensors(
    name: str,
    sensor: Sensor,
    landmarks: ArrayLike,
    tags: np.ndarray,
    associate: Associate | None,
    gate: float | None,
) -> tuple[KnownMapSensor, ...]:
    """The sensors of a suite, or the single sensor, in a known map; ValueError if invalid."""
    validation.check_parts(name, associate=associate)
    validation.check_gate(name, gate)

    def one(sensor: Sensor, measured: int | None, ignored: bool) -> KnownMapSensor:
        method = associate or known_association()
        return KnownMapSensor(sensor, method, gate, landmarks, tags, measured, ignored)

    if not isinstance(sensor, Suite):
        return (one(sensor, None, False),)
    return tuple(one(part.sensor, part.places, part.sees == "robots") for part in sensor.parts)


def check_resampling(name: str, resample: object, threshold: float) -> None:
    """Raise ValueError unless the method is a function and the threshold in [0, 1]."""
    if not callable(resample):
        raise ValueError(f"{name}: expected resample to be a function, got {resample!r}")
    if validation.is_concrete(threshold) and not 0 <= threshold <= 1:
        raise ValueError(f"{name}: expected a threshold from 0 to 1, got {threshold}")


def checked_least(name: str, particles: int, least: int | None) -> int:
    """The least number of particles, which by default is 50, or the capacity."""
    validation.check_count(f"{name}: particles", particles)
    if least is None:
        return min(_LEAST, particles)
    validation.check_count(f"{name}: least", least)
    if least > particles:
        raise ValueError(f"{name}: expected least <= particles = {particles}, got {least}")
    return least


def checked_box(name: str, box: ArrayLike | None) -> np.ndarray | None:
    """The box (2, 2), rows its lowest and highest (x, y); ValueError where it has no inside."""
    if box is None:
        return None
    limits = np.asarray(box, np.float64)
    if limits.shape != (2, 2) or not np.isfinite(limits).all() or not (limits[1] > limits[0]).all():
        raise ValueError(
            f"{name}: expected a box of shape (2, 2), its lowest and highest (x, y), got {box!r}"
        )
    return limits
