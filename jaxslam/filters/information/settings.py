"""What the information filters share: their models and options, checked where one is made."""

import dataclasses

from jaxslam import validation
from jaxslam.charts import Euclidean
from jaxslam.core.numbers import check_count, check_gate, check_positive
from jaxslam.core.record import record, static
from jaxslam.math.arrays import Number
from jaxslam.protocols import Filter, Motion, Sensor
from jaxslam.sensors.suite import Suite


@record
class InformationFilter(Filter):
    """Models and options of an information filter, whose error is in map coordinates.

    Raises ValueError on a capacity below 1, a gate or floor not above 0, a suite, or a sensor that
    has no landmarks or whose landmarks become points.
    """

    motion: Motion
    sensor: Sensor
    """the models; Jacobians come from `jax.jacfwd`, at the estimate"""
    capacity: int = static()
    """landmark slots N; a new landmark in a full map is `Status.OVERFLOW`"""
    _: dataclasses.KW_ONLY
    gate: Number | None = None
    """reject a measurement whose squared Mahalanobis distance exceeds this"""
    floor: Number = 1e-4
    """standard deviation [m, rad] added to a singular pose_cov, which has no inverse"""
    chart = Euclidean()

    def __post_init__(self) -> None:
        name, sensor = type(self).__name__, self.sensor
        validation.check_models(name, self.motion, sensor)
        check_count(f"{name}: capacity", self.capacity)
        check_gate(name, self.gate)
        check_positive(name, floor=self.floor)
        if isinstance(sensor, Suite):
            raise ValueError(f"{name}: expected one sensor, not a suite")
        if len(sensor.landmark) == 0:
            raise ValueError(f"{name}: expected a sensor of landmarks, got {sensor.name}")
        if sensor.reduced is not None:
            raise ValueError(
                f"{name}: the landmarks of {sensor.name} are converted to points, which is not "
                "supported"
            )
        super().__post_init__()
