"""Ellipses of covariances, and the limits of a square panel."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

Limits = tuple[tuple[float, float], tuple[float, float]]
"""of x and of y"""


def ellipses(
    means: Float[np.ndarray, "N 2"],
    covs: Float[np.ndarray, "N 2 2"],
    n_sigma: float = 3.0,
    points: int = 64,
) -> Float[np.ndarray, "N C 2"]:
    """The closed contours (N, points + 1, 2) of Mahalanobis distance n_sigma, Solà (84).

    mean + n L (cos α, sin α) with P = L Lᵀ. A positive semi-definite P gives a segment or a point;
    one that is not finite or indefinite gives NaN.
    """
    covs = np.asarray(covs, np.float64)
    finite = np.isfinite(covs).all(axis=(1, 2))
    a, b, c = (np.where(finite, covs[:, i, j], 0.0) for i, j in ((0, 0), (1, 0), (1, 1)))
    tolerance = 1e-6 * np.maximum(np.abs(a), np.abs(c))
    first = np.sqrt(np.maximum(a, 0.0))
    below = np.divide(b, first, out=np.zeros_like(b), where=first > 0)
    rest = c - below**2
    bad = ~finite | (a < -tolerance) | (rest < -tolerance)
    bad |= (first == 0) & (np.abs(b) > tolerance)
    second = np.sqrt(np.maximum(rest, 0.0))
    around = np.linspace(0.0, 2 * np.pi, points + 1)
    cosine, sine = n_sigma * np.cos(around), n_sigma * np.sin(around)
    along = first[:, None] * cosine
    across = below[:, None] * cosine + second[:, None] * sine
    contours: np.ndarray = np.asarray(means, np.float64)[:, None] + np.stack(
        [along, across], axis=2
    )
    contours[bad] = np.nan
    return contours


def ellipse(
    mean: np.ndarray, cov: np.ndarray, n_sigma: float = 3.0, points: int = 64
) -> np.ndarray:
    """The closed contour (points + 1, 2) of Mahalanobis distance n_sigma: `ellipses` of one.

    n_sigma sets the size and points the smoothness. Raises ValueError if P is not 2×2, not finite
    or indefinite.
    """
    cov = np.asarray(cov, np.float64)
    if cov.shape != (2, 2) or not np.all(np.isfinite(cov)):
        raise ValueError(f"ellipse: expected a finite 2×2 covariance, got {cov}")
    contour = ellipses(np.zeros((1, 2)), cov[None], n_sigma, points)[0]
    if np.isnan(contour).all():
        raise ValueError(f"ellipse: expected a positive semi-definite covariance, got {cov}")
    return np.asarray(np.asarray(mean) + contour)


def extent(clouds: Sequence[np.ndarray]) -> float:
    """The larger side of the bounding box of some points, or 1 if it is 0."""
    return float(np.nanmax(np.ptp(_finite(clouds), axis=0))) or 1.0


def square_limits(clouds: Sequence[np.ndarray]) -> Limits:
    """The limits of a square panel about some points, with a margin."""
    every = _finite(clouds)
    x, y = (every.min(axis=0) + every.max(axis=0)) / 2
    half = 0.56 * extent(clouds)
    return (x - half, x + half), (y - half, y + half)


def _finite(clouds: Sequence[np.ndarray]) -> np.ndarray:
    """The finite ones of some points, the origin if there is none."""
    every = np.concatenate(clouds)
    every = every[np.isfinite(every).all(axis=1)]
    return every if len(every) else np.zeros((1, 2))
