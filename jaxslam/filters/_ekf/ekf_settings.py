"""The options of EKF-SLAM, where they are handed on."""

from typing import TypedDict

from jaxslam.core.protocols import Associate, Chart, Life, Linearizer
from jaxslam.filters._ekf.correction import Covariance
from jaxslam.filters._ekf.ekf_slam import CorrectionOrder
from jaxslam.math._arrays import Number


class EkfOptions(TypedDict, total=False):
    """The options of `EkfSlam`, where they are handed on."""

    chart: Chart
    linearize: Linearizer
    associate: Associate
    correction: CorrectionOrder
    gate: Number | None
    iterations: int
    covariance: Covariance
    births: int | None
    life: Life | None
