"""Small linear algebra: products, Cholesky factors, inverses and roots of a filter's matrices."""

from jaxslam.math._linalg.factors import cholesky, root_psd, solve_lower, solve_psd, triangular_root
from jaxslam.math._linalg.inverses import inverse, inverse_psd, whitener, whitener_by_rows
from jaxslam.math._linalg.products import (
    gram,
    gram_both,
    matmul,
    rematerialize,
    self_gram,
    symmetrize,
    total,
)

__all__ = [
    "cholesky",
    "gram",
    "gram_both",
    "inverse",
    "inverse_psd",
    "matmul",
    "rematerialize",
    "root_psd",
    "self_gram",
    "solve_lower",
    "solve_psd",
    "symmetrize",
    "total",
    "triangular_root",
    "whitener",
    "whitener_by_rows",
]
