"""Smoothing: estimators of the whole path and map from the whole log, or from its last steps.

Each is the graph of the log, solved along the path.
"""

from jaxslam._public import publish
from jaxslam.graphs.smoothing._batch_map import BatchMap
from jaxslam.graphs.smoothing._fixed_lag import FixedLag
from jaxslam.graphs.smoothing._smoother import Smoother

__all__ = ["BatchMap", "FixedLag", "Smoother"]

publish(__name__)
