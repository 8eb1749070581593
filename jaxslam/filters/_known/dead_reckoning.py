"""Dead reckoning: prediction of the pose without measurements, as a baseline."""

import dataclasses

from jaxtyping import Array, Float

from jaxslam.charts import Euclidean
from jaxslam.core._record import field, record
from jaxslam.core._validation import motion_model, sensor_model
from jaxslam.core.protocols import Chart, Filter, Linearizer, Motion, Sensor
from jaxslam.core.slots import Joint
from jaxslam.core.types import Estimate, Info, Scan
from jaxslam.core.validation import instance_of
from jaxslam.filters._ekf.checks import check_fit
from jaxslam.filters._ekf.ekf_slam import EkfSlam
from jaxslam.filters._reporting import info_of_ignored
from jaxslam.linearize._first_order import AtEstimate


@record
class DeadReckoning(Filter):
    """The predicted robot alone, x ← f(x, u, 0) and P ← F P Fᵀ + W Q Wᵀ (Solà (14), (15)).

    Every measurement is `Status.UNMATCHED`, and the map stays empty. The sensor only gives the size
    of measurements; chart and linearize are those of `EkfSlam`, with the same errors.
    """

    motion: Motion = field(check=motion_model)
    sensor: Sensor = field(check=sensor_model)
    _: dataclasses.KW_ONLY
    chart: Chart = field(default=Euclidean(), check=instance_of(Chart))
    linearize: Linearizer = field(default=AtEstimate(), check=instance_of(Linearizer))
    further = True

    def __post_init__(self) -> None:
        check_fit(self.sensor, self.chart, self.linearize)
        super().__post_init__()

    def init(self, pose: Float[Array, "R"], pose_cov: Float[Array, "R R"]) -> Joint:
        return self._ekf.init(pose, pose_cov)

    def predict(self, state: Joint, u: Float[Array, "U"], key: Array) -> Joint:
        return self._ekf.predict(state, u, key)

    def update(self, state: Joint, scan: Scan, key: Array) -> tuple[Joint, Info]:
        return state, info_of_ignored(scan)

    def estimate(self, state: Joint) -> Estimate:
        return self._ekf.estimate(state)

    @property
    def _ekf(self) -> EkfSlam:
        """The EKF whose prediction it is; its map of one slot stays empty."""
        return EkfSlam(self.motion, self.sensor, 1, chart=self.chart, linearize=self.linearize)
