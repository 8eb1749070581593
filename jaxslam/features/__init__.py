"""Features of laser scans: straight segments, each with its covariance."""

from jaxslam.features.fits import fit_line
from jaxslam.features.segments import Segments, segments

__all__ = ["Segments", "fit_line", "segments"]
