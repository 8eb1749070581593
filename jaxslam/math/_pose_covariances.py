"""Pose covariances on the host: their scale, and where they are none by more than rounding."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

_ROUNDING = 32
"""Largest claimed deviation, in ulp of its coordinate, that counts as zero."""


class CovarianceFaults(NamedTuple):
    """Masks of the steps whose claimed pose covariance is none, by more than rounding."""

    asymmetric: Bool[np.ndarray, "*steps"]
    indefinite: Bool[np.ndarray, "*steps"]
    """it has a negative eigenvalue"""


def covariance_faults(
    pose: Float[np.ndarray, "*steps 3"], cov: Float[np.ndarray, "*steps 3 3"]
) -> CovarianceFaults:
    """The steps whose pose covariance is not symmetric, or not positive semi-definite.

    P is scaled by `inverse_deviations`, so that its entries are correlations. It is not
    symmetric where p_ij and p_ji differ by more than ∛eps, and indefinite where the least
    eigenvalue of its symmetric part is below -∛eps: 5e-3 in float32, 6e-6 in float64. Rounding
    leaves κ eps, κ the ratio of the covariances before and after the updates: 4 to 400 eps in a
    textbook EKF that never symmetrizes its P, which ∛eps exceeds a hundred times, and ∛eps only
    where two thirds of the digits are lost. A mistake in a formula leaves correlations, 0.01 to 1.
    """
    eps = float(np.finfo(cov.dtype).eps)
    with np.errstate(all="ignore"):
        units = inverse_deviations(pose, cov, eps)
        unit = np.stack(units, axis=-1)
        scaled = cov.astype(np.float64) * unit[..., :, None] * unit[..., None, :]
        asymmetric = asymmetry(cov, units, 3) > np.cbrt(eps)
    finite = np.isfinite(scaled).all(axis=(-2, -1))
    scaled = np.where(finite[..., None, None], scaled, 0.0)
    even = (scaled + np.swapaxes(scaled, -2, -1)) / 2
    indefinite = np.zeros_like(asymmetric)
    # Most are positive definite, which their minors tell faster than eigenvalues do.
    minor = even[..., 0, 0] * even[..., 1, 1] - even[..., 0, 1] ** 2
    doubtful = ~((even[..., 0, 0] > 0) & (minor > 0) & (np.linalg.det(even) > 0))
    indefinite[doubtful] = np.linalg.eigvalsh(even[doubtful])[:, 0] < -np.cbrt(eps)
    return CovarianceFaults(asymmetric, indefinite)


def inverse_deviations(pose: np.ndarray, cov: np.ndarray, eps: float) -> list[np.ndarray]:
    """1/σ of x, y and θ, σ² = |P_ii|, which scale a pose covariance to a unit diagonal.

    x and y, both metres, share one. 0 where σ is what rounding makes of zero: at most `_ROUNDING`
    ulp of the coordinate, that is of max(|x|, |y|), or of π.
    """
    x, y, heading = (np.abs(cov[..., i, i].astype(np.float64)) for i in range(3))
    reach = np.abs(pose[..., :2]).max(axis=-1)

    def unit(variance: np.ndarray, size: np.ndarray | float) -> np.ndarray:
        certain = variance > (_ROUNDING * eps * size) ** 2
        return np.where(certain, 1.0 / np.sqrt(np.where(certain, variance, 1.0)), 0.0)

    metres = unit(np.maximum(x, y), reach)
    return [metres, metres, unit(heading, np.pi)]


def asymmetry(cov: np.ndarray, unit: list[np.ndarray], size: int) -> np.ndarray:
    """The largest difference of two entries of the leading block, scaled, across its diagonal."""
    gap = [
        np.abs((cov[..., i, j].astype(np.float64) - cov[..., j, i]) * unit[i] * unit[j])
        for i in range(size)
        for j in range(i)
    ]
    out: np.ndarray = np.maximum.reduce(gap)
    return out
