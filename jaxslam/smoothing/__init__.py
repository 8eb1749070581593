"""Smoothing: estimators of the whole path and map from the whole log."""

from jaxslam.smoothing.batch_map import batch_map
from jaxslam.smoothing.smooth import smooth

__all__ = ["batch_map", "smooth"]
