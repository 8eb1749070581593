"""The settings of the information filters, validated once."""

from dataclasses import dataclass

from jaxslam import validation
from jaxslam.core.numbers import check_count, check_gate
from jaxslam.protocols import Motion, Sensor
from jaxslam.sensors.suite import Suite


@dataclass(frozen=True, eq=False)
class InformationSettings:
    """Models and options of an information filter. Raises ValueError, by its name, if invalid."""

    name: str
    motion: Motion
    sensor: Sensor
    capacity: int
    """landmark slots N"""
    gate: float | None
    """greatest squared Mahalanobis distance of an innovation"""
    floor: float
    """standard deviation [m, rad] added to a singular initial covariance"""

    def __post_init__(self) -> None:
        name, sensor = self.name, self.sensor
        validation.check_models(name, self.motion, sensor)
        check_count(f"{name}: capacity", self.capacity)
        check_gate(name, self.gate)
        if not self.floor > 0:
            raise ValueError(f"{name}: expected a floor above 0, got {self.floor}")
        if isinstance(sensor, Suite):
            raise ValueError(f"{name}: expected one sensor, not a suite")
        if len(sensor.landmark) == 0:
            raise ValueError(f"{name}: expected a sensor of landmarks, got {sensor.name}")
        if sensor.reduced is not None:
            raise ValueError(
                f"{name}: the landmarks of {sensor.name} are converted to points, which is not "
                "supported"
            )


@dataclass(frozen=True, eq=False)
class SparseSettings(InformationSettings):
    """The settings of a filter with an active set and lists of links."""

    active: int
    """landmarks that may be active, if the map has as many"""
    links: int
    """K, most links in the list of a landmark"""
    passive: int
    """landmarks whose means are recovered in rotation each scan, if the map has as many"""
    sweeps: int
    """rounds of mean recovery a scan"""
    conservative: bool
    """a full list drops a link so that Ω loses information, where it stays positive definite"""
    whole: bool
    """covariances of the estimate are of the whole Ω, not of Markov blankets"""

    def __post_init__(self) -> None:
        super().__post_init__()
        for option in ("active", "links", "passive", "sweeps"):
            check_count(f"{self.name}: {option}", getattr(self, option))
        if not self.sensor.of_points:
            raise ValueError(
                f"{self.name}: expected landmarks (x, y), got {self.sensor.landmark} of "
                f"{self.sensor.name}"
            )

    @property
    def active_size(self) -> int:
        """The size A of the active set."""
        return min(self.active, self.capacity)

    @property
    def recovered(self) -> int:
        """The number of passive means that a round of mean recovery updates."""
        return min(self.passive, self.capacity)
