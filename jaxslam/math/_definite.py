"""Whether matrices are symmetric, positive semi-definite or regular, by NumPy, in any units.

Coordinates may be metres beside radians, so a matrix is compared with one scaled to a unit
diagonal. Rounding is that of its dtype: n eps of the entries, and some more that the products have
from which it was made.
"""

import numpy as np
from jaxtyping import Bool, Float

_ROUNDED = 100
"""How many n eps of a unit diagonal rounding may leave of an eigenvalue that should be 0."""


def is_asymmetric(
    matrix: Float[np.ndarray, "*batch n n"], tolerance: float = 0.0
) -> Bool[np.ndarray, "*batch"]:
    """Whether entries differ from those across the diagonal by more than a share of √(a_ii a_jj).

    tolerance: the share, where that is above rounding.
    """
    off = np.abs(_scale(matrix - np.swapaxes(matrix, -1, -2), _sizes(matrix, 0.0)[0]))
    return np.asarray((off > _tolerance(matrix, tolerance)).any(axis=(-1, -2)))


def is_indefinite(
    matrix: Float[np.ndarray, "*batch n n"], tolerance: float = 0.0, least: float = 0.0
) -> Bool[np.ndarray, "*batch"]:
    """Whether an eigenvalue of symmetric matrices, with a unit diagonal, is negative.

    Args:
        tolerance: by how much, where that is above rounding.
        least: share of the largest entry, where above rounding, that a variance may be off by.
    """
    size, rounding = _sizes(matrix, least)
    variance = np.diagonal(matrix, axis1=-2, axis2=-1)
    # A variance of -1e-17 next to 1 is 0.
    raised = matrix - np.where(variance < 0, variance, 0)[..., None] * np.eye(matrix.shape[-1])
    eigenvalues = np.linalg.eigvalsh(_scale(raised, size))
    negative = (eigenvalues < -_tolerance(matrix, tolerance)).any(axis=-1)
    return np.asarray((variance < -rounding).any(axis=-1) | negative)


def is_invertible(matrix: Float[np.ndarray, "*batch n n"]) -> Bool[np.ndarray, "*batch"]:
    """Whether symmetric matrices are positive definite and have an inverse of some digits."""
    variance = np.diagonal(matrix, axis1=-2, axis2=-1)
    unit = np.where(variance > 0, variance, 1.0)
    scaled = _scale(matrix, np.sqrt(unit.astype(np.float64)))
    eigenvalues = np.linalg.eigvalsh(scaled)
    return np.asarray(
        (variance > 0).all(axis=-1) & (eigenvalues > _tolerance(matrix, 0.0)).all(axis=-1)
    )


def _sizes(
    matrix: Float[np.ndarray, "*batch n n"], least: float
) -> tuple[Float[np.ndarray, "*batch n"], Float[np.ndarray, "*batch 1"]]:
    """√a_ii, of a variance of at least rounding; and that rounding, of the largest entry."""
    largest = np.abs(matrix).max(axis=(-1, -2), initial=0.0).astype(np.float64)[..., None]
    rounding = max(least, matrix.shape[-1] * _eps(matrix)) * largest
    variance = np.maximum(np.diagonal(matrix, axis1=-2, axis2=-1), rounding)
    return np.sqrt(np.where(variance > 0, variance, 1.0)), rounding


def _scale(
    matrix: Float[np.ndarray, "*batch n n"], size: Float[np.ndarray, "*batch n"]
) -> Float[np.ndarray, "*batch n n"]:
    return np.asarray(matrix / size[..., :, None] / size[..., None, :])


def _eps(matrix: np.ndarray) -> float:
    return float(np.finfo(matrix.dtype if matrix.dtype.kind == "f" else np.float64).eps)


def _tolerance(matrix: Float[np.ndarray, "*batch n n"], tolerance: float) -> float:
    return float(max(tolerance, _ROUNDED * matrix.shape[-1] * _eps(matrix)))
