"""Smoothing: estimators of the whole path and map from the whole log, or from its last steps.

Each is the graph of the log, solved along the path (`jaxslam.graphs.chain`).
"""

from jaxslam.smoothing.batch_map import batch_map
from jaxslam.smoothing.fixed_lag import fixed_lag
from jaxslam.smoothing.smooth import smooth

__all__ = ["batch_map", "fixed_lag", "smooth"]
