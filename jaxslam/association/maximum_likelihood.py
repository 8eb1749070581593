"""Maximum-likelihood association of each measurement on its own."""

from jaxslam.association.gates import check_gates, far_from_all, mutual
from jaxslam.protocols import Associate, Association, Prediction
from jaxslam.types import Scan


def maximum_likelihood(gate: float, new_gate: float | None = None) -> Associate:
    """Maximum-likelihood association: as `nearest`, by the least d² + log |S|.

    d² + log |S| is -2 log N(ν; 0, S) up to a constant. The determinant matters: a landmark of large
    covariance has small d² to all measurements, but a low likelihood (Thrun, Burgard &
    Fox, Probabilistic Robotics, Table 7.3). The gates are of d², as those of `nearest`.

    Raises:
        ValueError: on a negative gate, or a new_gate below it.
    """
    beyond = check_gates("maximum_likelihood", gate, new_gate)

    def associate(prediction: Prediction, scan: Scan) -> Association:
        pairs = prediction.pairs(scan)
        compatible = pairs.possible & (pairs.distance <= gate)
        slot = mutual(pairs.distance + pairs.log_det, compatible)
        return Association(slot, far_from_all(pairs, scan, beyond) & (slot < 0))

    return associate
