"""Charts: error coordinates of the covariance."""

from jaxslam.charts.euclidean import Euclidean
from jaxslam.charts.left_invariant import LeftInvariant
from jaxslam.charts.right_invariant import RightInvariant
from jaxslam.protocols import Chart

REGISTRY: dict[str, type[Chart]] = {
    "euclidean": Euclidean,
    "left_invariant": LeftInvariant,
    "right_invariant": RightInvariant,
}

__all__ = ["REGISTRY", "Euclidean", "LeftInvariant", "RightInvariant"]
