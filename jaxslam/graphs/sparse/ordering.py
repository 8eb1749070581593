"""The order of elimination: which permutation of the variables keeps the factor sparse."""

import numpy as np
from jaxtyping import Int
from scipy.sparse import coo_matrix, diags_array
from scipy.sparse.linalg import splu


def minimum_degree(
    size: int, first: Int[np.ndarray, "E"], second: Int[np.ndarray, "E"]
) -> Int[np.ndarray, "size"]:
    """The variables in a minimum-degree order, for a graph with edges first-second.

    SuperLU's multiple minimum degree (Liu 1985, "Modification of the minimum-degree algorithm by
    multiple elimination", ACM TOMS 11(2)) on the pattern of A + Aᵀ. SciPy gives it only with a
    factorization, here of a diagonally dominant matrix with one number a block.
    """
    links = coo_matrix((-np.ones(len(first)), (first, second)), (size, size))
    links = links + links.T
    dominant = diags_array(1.0 + np.asarray(abs(links).sum(axis=0)).ravel()) + links
    options = {"SymmetricMode": True}
    factors = splu(
        dominant.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options
    )
    return np.argsort(factors.perm_c)
