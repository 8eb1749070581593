"""Smoothing: the whole path and map from the whole log, as estimators that the harness runs."""

from jaxslam.smoothing.batch_map import batch_map
from jaxslam.smoothing.smooth import smooth

__all__ = ["batch_map", "smooth"]
