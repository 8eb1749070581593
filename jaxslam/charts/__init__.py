"""Charts: which error a filter's covariance is the covariance of."""

from collections.abc import Callable

from jaxslam.charts.euclidean import euclidean
from jaxslam.charts.right_invariant import right_invariant
from jaxslam.protocols import Chart

REGISTRY: dict[str, Callable[[], Chart]] = {
    "euclidean": euclidean,
    "right_invariant": right_invariant,
}

__all__ = ["REGISTRY", "euclidean", "right_invariant"]
