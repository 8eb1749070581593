"""Linear algebra of small covariance matrices: Cholesky factors, inverses, solutions, roots."""

from jaxslam._public import publish
from jaxslam.math._linalg import cholesky, inverse, root_psd, solve_lower, solve_psd, symmetrize

__all__ = ["cholesky", "inverse", "root_psd", "solve_lower", "solve_psd", "symmetrize"]

publish(__name__)
