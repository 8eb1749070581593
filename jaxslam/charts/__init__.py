"""Charts: error coordinates of the covariance."""

from collections.abc import Callable

from jaxslam.charts.euclidean import euclidean
from jaxslam.charts.left_invariant import left_invariant
from jaxslam.charts.right_invariant import right_invariant
from jaxslam.protocols import Chart

REGISTRY: dict[str, Callable[[], Chart]] = {
    "euclidean": euclidean,
    "left_invariant": left_invariant,
    "right_invariant": right_invariant,
}

__all__ = ["REGISTRY", "euclidean", "left_invariant", "right_invariant"]
