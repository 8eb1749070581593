"""Lines and parabolas through the ends of beams, weighted by their noise, in NumPy."""

import numpy as np
from jaxtyping import Float

_ITERATIONS = 4


def ends_of(
    angle: Float[np.ndarray, "n"], distance: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n 2"]:
    """The ends of beams [m]."""
    return np.asarray(distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1))


def fit_line(
    angle: Float[np.ndarray, "n"],
    distance: Float[np.ndarray, "n"],
    sigma: float,
    sigma_angle: float = 0.0,
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2 2"], float]:
    """The line (r, α) through the ends of some beams, its covariance, and χ² of the residuals.

    With e the direction of a beam and n the normal, the wall is met at ρ* = r/(n·e), and the end ρe
    is off the line by d = n·e (ρ - ρ*). To first order d has the variance
    w⁻¹ = (n·e)² σ² + (ρ* n⊥·e)² σ_β². Minimized is Σ w d², the total least squares weighted so, in
    closed form with weights that are 1 at first, then by Gauss-Newton steps with the slopes
    g = ∂d/∂(r, α) = (-1, n⊥·ρ*e) at the predicted points; at the measured ones the noise in g would
    bias α. The covariance is (Σ w g gᵀ)⁻¹, the bound of Cramér and Rao.

    The normal points away from the laser (n·e > 0), so r may come out below 0 for a wall that the
    laser is nearly on.

    Raises ValueError for a sigma not above 0 or a sigma_angle below 0, beams that are not finite,
    fewer than 2, all the same, or in line with the laser.
    """
    if not (0 < sigma < np.inf and 0 <= sigma_angle < np.inf):
        raise ValueError(
            "fit_line: expected sigma above 0 and sigma_angle of at least 0, got "
            f"{sigma} and {sigma_angle}"
        )
    if np.ndim(angle) != 1 or np.shape(angle) != np.shape(distance):
        raise ValueError(
            f"fit_line: expected as many angles as ranges, got shapes {np.shape(angle)} and "
            f"{np.shape(distance)}"
        )
    points = ends_of(angle, distance)
    if not np.isfinite(points).all():
        raise ValueError("fit_line: expected finite angles and ranges")
    if len(points) < 2 or not np.ptp(points, axis=0).max() > 0:
        raise ValueError(f"fit_line: expected beams that end at different points, got {len(angle)}")
    e = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    middle = points.mean(axis=0)
    n = np.linalg.svd(points - middle, full_matrices=len(points) < 2)[2][1]
    n = n * (1.0 if (e @ n).sum() >= 0 else -1.0)
    line = np.array([n @ middle, np.arctan2(n[1], n[0])])
    information = np.eye(2)
    for _ in range(_ITERATIONS):
        n = np.array([np.cos(line[1]), np.sin(line[1])])
        toward, across = e @ n, e @ np.array([-n[1], n[0]])
        toward = np.maximum(toward, 1e-3)  # a beam along the wall says nothing of it
        met = line[0] / toward
        if np.ptp(met * across) <= 1e-9 * max(sigma, np.abs(distance).max()):
            raise ValueError("fit_line: expected beams whose ends are not in line with the laser")
        weight = 1 / ((toward * sigma) ** 2 + (met * across * sigma_angle) ** 2)
        off = toward * distance - line[0]
        slope = np.stack([-np.ones_like(met), met * across], axis=1)
        information = (weight[:, None] * slope).T @ slope
        line = line - np.linalg.solve(information, slope.T @ (weight * off))
    cov = np.linalg.inv(information)
    line[1] = np.arctan2(np.sin(line[1]), np.cos(line[1]))
    return line, cov, float((weight * off**2).sum())


def misfit_of_parabola(
    angle: Float[np.ndarray, "n"],
    distance: Float[np.ndarray, "n"],
    sigma: float,
    sigma_angle: float = 0.0,
) -> float:
    """The χ² of the residuals of a parabola through the ends of n beams, n - 3 degrees of freedom.

    y = f(x) with x along the line of total least squares. With t its direction and n its normal,
    y - f has to first order the variance (n·e - f' t·e)² σ² + ρ² (t·e + f' n·e)² σ_β².
    """
    e = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = distance[:, None] * e
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    (x, y), (along, toward) = ((rows @ axes.T).T for rows in (points, e))
    x = x - x.mean()
    scale = np.abs(x).max()
    powers = np.stack([np.ones_like(x), x / scale, (x / scale) ** 2], axis=1)
    slope, off = np.zeros_like(x), y
    for _ in range(_ITERATIONS):
        deviation = np.hypot(
            (toward - slope * along) * sigma, distance * (along + slope * toward) * sigma_angle
        )
        deviation = np.maximum(deviation, 1e-3 * sigma)  # a beam along the wall, as in `fit_line`
        found = np.linalg.lstsq(powers / deviation[:, None], y / deviation)[0]
        slope = (found[1] + 2 * found[2] * x / scale) / scale
        off = (y - powers @ found) / deviation
    return float(off @ off)
