"""Smoothing: estimators of the whole path and map from the whole log, or from its last steps.

Each is the graph of the log, solved along the path (`jaxslam.graphs.chain`).
"""

from jaxslam.graphs.smoothing.batch_map import BatchMap
from jaxslam.graphs.smoothing.fixed_lag import FixedLag
from jaxslam.graphs.smoothing.smoother import Smoother

__all__ = ["BatchMap", "FixedLag", "Smoother"]
