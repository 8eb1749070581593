"""Filters: recursive estimators behind the one `Filter` protocol."""

from jaxslam.filters.ekf_slam import ekf_slam

__all__ = ["ekf_slam"]
