"""Features of laser scans: straight segments, each with its covariance."""

from jaxslam.features.segments import Segments, fit_line, segments

__all__ = ["Segments", "fit_line", "segments"]
