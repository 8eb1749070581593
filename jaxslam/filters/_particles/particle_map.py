"""A filter with a map of independent landmarks in each particle: its options, and their checks."""

from jaxslam.core.protocols import Associate, Filter, Life, Sensor
from jaxslam.core.validation import InvalidField
from jaxslam.math._arrays import Number
from jaxslam.sensors._suite import Suite


class ParticleMapFilter(Filter):
    """A filter with a separate EKF for each landmark of a particle: `FastSlam`, or `Mapping` with
    its only particle. The steps of a map (`proposal`, `landmark_ekf`) take it.

    Raises ValueError on a capacity or births below 1, a gate not above 0 and below 1, or a sensor
    that is a suite, absolute, or whose landmarks turn into points.
    """

    sensor: Sensor
    capacity: int
    associate: Associate
    gate: Number | None
    births: int | None
    life: Life | None

    def __post_init__(self) -> None:
        sensor = self.sensor
        if isinstance(sensor, Suite) or not sensor.landmark or sensor.reduced is not None:
            raise InvalidField(
                "sensor",
                "expected one sensor of landmarks, not a suite, an absolute sensor or landmarks "
                f"that are converted to points, got {sensor.name}",
            )
        super().__post_init__()
