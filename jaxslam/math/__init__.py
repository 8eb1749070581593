"""General mathematics: angles, SE(2), linear algebra, statistics, array types."""

from jaxslam.math._gaussians import GaussianTerms, gaussian_terms

__all__ = ["GaussianTerms", "gaussian_terms"]
