"""Dead reckoning: prediction of the pose without measurements, as a baseline."""

import dataclasses

from jaxtyping import Array

from jaxslam import validation
from jaxslam.filters.ekf.ekf_slam import ekf_slam
from jaxslam.filters.reporting import nothing_of
from jaxslam.protocols import Chart, Filter, Linearizer, Motion, Sensor
from jaxslam.slots import Joint
from jaxslam.types import Info, Scan


def dead_reckoning(
    motion: Motion,
    sensor: Sensor,
    *,
    chart: Chart | None = None,
    linearize: Linearizer | None = None,
) -> Filter:
    """The predicted pose alone, x ← f(x, u, 0) and P ← F P Fᵀ + W Q Wᵀ (Solà (14), (15)).

    Every measurement is `Status.UNMATCHED`, and the map stays empty. The sensor only gives the size
    of measurements; chart and linearize are those of `ekf_slam`, with the same errors.
    """
    validation.check_models("dead_reckoning", motion, sensor)
    validation.check_parts("dead_reckoning", chart=chart, linearize=linearize)
    filter = ekf_slam(motion, sensor, 1, chart=chart, linearize=linearize)

    def update(joint: Joint, scan: Scan, key: Array) -> tuple[Joint, Info]:
        return joint, nothing_of(scan)

    return dataclasses.replace(filter, name="dead_reckoning", update=update)
