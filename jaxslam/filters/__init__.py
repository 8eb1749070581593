"""Filters: recursive estimators behind the one `Filter` protocol."""

from jaxslam.filters.compressed_ekf_slam import compressed_ekf_slam
from jaxslam.filters.ekf_slam import ekf_slam

__all__ = ["compressed_ekf_slam", "ekf_slam"]
