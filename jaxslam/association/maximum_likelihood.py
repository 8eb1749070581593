"""Maximum-likelihood association of each measurement on its own."""

from jaxslam.association.gates import check_gates, far_from_all, mutual
from jaxslam.core.record import record
from jaxslam.math.arrays import Number
from jaxslam.protocols import Association, Prediction
from jaxslam.types import Scan


@record
class MaximumLikelihood:
    """Maximum-likelihood association: as `nearest`, by the least d² + log |S|.

    d² + log |S| is -2 log N(ν; 0, S) up to a constant. The determinant matters: a landmark of large
    covariance has small d² to all measurements, but a low likelihood (Thrun, Burgard &
    Fox, Probabilistic Robotics, Table 7.3). The gates are of d², as those of `nearest`.

    Raises:
        ValueError: on a negative gate, or a new_gate below it.
    """

    gate: Number
    new_gate: Number | None = None

    def __post_init__(self) -> None:
        check_gates("MaximumLikelihood", self.gate, self.new_gate)

    def __call__(self, prediction: Prediction, scan: Scan) -> Association:
        pairs = prediction.pairs(scan)
        compatible = pairs.possible & (pairs.distance <= self.gate)
        slot = mutual(pairs.distance + pairs.log_det, compatible)
        return Association(slot, far_from_all(pairs, scan, self.gate, self.new_gate) & (slot < 0))
