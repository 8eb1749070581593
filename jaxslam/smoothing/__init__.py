"""Smoothing: estimators of the whole path and map from the whole log, or from its last steps.

Each is the graph of the log, solved along the path (`jaxslam.graphs.chain`).
"""

from jaxslam.smoothing.batch_map import BatchMap
from jaxslam.smoothing.fixed_lag import FixedLag
from jaxslam.smoothing.forward_pass import LogEstimator
from jaxslam.smoothing.smoother import Smoother

__all__ = ["BatchMap", "FixedLag", "LogEstimator", "Smoother"]
