"""General mathematics: angles, SE(2), linear algebra, statistics, array types."""

from jaxslam._public import publish
from jaxslam.math import angles, linalg, numpy_poses, se2, stats, uncertain_poses
from jaxslam.math._gaussians import GaussianTerms, gaussian_terms

__all__ = [
    "GaussianTerms",
    "angles",
    "gaussian_terms",
    "linalg",
    "numpy_poses",
    "se2",
    "stats",
    "uncertain_poses",
]

publish(__name__)
