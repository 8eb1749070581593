"""The parameters of the ray-cast model, learnt from ranges and those that a map predicts."""

from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxslam.core.numbers import check_positive
from jaxslam.core.types import Beams
from jaxslam.laser.grids.beam_models.ray_cast import Mixture, check_weights, mixture_log_density

START = Mixture(0.6, 0.15, 0.1, 0.15, 0.2, 0.5)
"""Where the search begins."""
_LEAST = 1e-6
"""The least σ [m], where ranges are as expected, and length 1/λ."""


def fit(
    z: ArrayLike,
    expected: ArrayLike,
    max_range: float,
    *,
    method: Literal["gradient", "em"] = "gradient",
    start: Mixture = START,
    iterations: int = 200,
) -> Mixture:
    """The mixture of the largest likelihood for ranges (K,) and those expected (K,).

    "gradient": BFGS on the log-likelihood, by automatic differentiation, over the logarithms of
        shares (normalized), σ and λ.
    "em": expectation-maximization; σ² and 1/λ are the weighted means of (z - z*)² and z, which
        neglects the limits [0, max_range] and [0, z*] of the two densities: Thrun, Burgard & Fox
        2005, "Probabilistic robotics", table 6.2. So λ is too large where obstacles are near.

    Ranges without information are left out (`Beams`).

    Raises ValueError on lengths that differ, expected ranges that are not finite or below 0, no
    range with information, an invalid start, and a max_range that is not above 0.
    """
    ranges, stars = np.asarray(z, np.float64), np.asarray(expected, np.float64)
    if ranges.ndim != 1 or ranges.shape != stars.shape or len(ranges) == 0:
        raise ValueError(
            "fit: expected at least one range, and as many as expected ones, got "
            f"{ranges.shape} and {stars.shape}"
        )
    check_positive("fit: start", sigma=start.sigma, rate=start.rate)
    check_weights("fit: start", dict(zip(Mixture._fields[:4], start[:4], strict=True)))
    check_positive("fit", max_range=max_range)
    if not np.all(np.isfinite(stars)) or stars.min() < 0:
        raise ValueError("fit: expected predicted ranges that are finite and not below 0")
    met, far = Beams(ranges, np.zeros_like(ranges), np.ones(len(ranges), bool)).returns(max_range)
    if not (met | far).any():
        raise ValueError(f"fit: none of {len(ranges)} ranges is above 0")
    if method not in ("gradient", "em"):
        raise ValueError(f'fit: expected method "gradient" or "em", got {method!r}')
    ranges = np.where(far, max_range, ranges)[met | far]
    stars = np.minimum(stars, max_range)[met | far]
    if method == "em":
        mixture = Mixture(*(float(np.asarray(value)) for value in start))
        for _ in range(iterations):
            mixture = _em_step(mixture, ranges, stars, max_range)
        return mixture

    from scipy.optimize import minimize  # slow to load

    def cost(x: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = _cost_and_slope(x, ranges, stars, max_range)
        return float(value), np.asarray(slope, np.float64)

    first = np.log(np.maximum([float(np.asarray(value)) for value in start], 1e-6))
    found = minimize(cost, first, jac=True, method="BFGS", options={"maxiter": iterations})
    return Mixture(*(float(np.asarray(value)) for value in _mixture(jnp.asarray(found.x))))


def _mixture(x: Float[Array, "6"]) -> Mixture:
    shares, scales = jax.nn.softmax(x[:4]), _LEAST + jnp.exp(x[4:])
    return Mixture(shares[0], shares[1], shares[2], shares[3], scales[0], scales[1])


@jax.jit
def _cost_and_slope(x: Array, z: Array, stars: Array, max_range: Array) -> tuple[Array, Array]:
    def cost(x: Array) -> Array:
        return -mixture_log_density(_mixture(x), z, stars, max_range).mean()

    return jax.value_and_grad(cost)(x)


def _em_step(mixture: Mixture, z: np.ndarray, stars: np.ndarray, max_range: float) -> Mixture:
    """The shares of the four components in each range, and from these the parameters."""
    hit, short, maximum, random, sigma, rate = (float(np.asarray(value)) for value in mixture)
    far, nothing = z >= max_range, stars >= max_range
    normal = np.exp(-0.5 * ((z - stars) / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))
    end = np.maximum(stars, 1e-6)
    early = np.where(z <= end, rate * np.exp(-rate * z) / -np.expm1(-rate * end), 0.0)
    parts = np.stack(
        [
            hit * np.where(nothing, far, np.where(far, 0.0, normal)),
            short * np.where(far, 0.0, early),
            maximum * far,
            random * np.where(far, 0.0, 1 / max_range),
        ]
    )
    total = parts.sum(axis=0)
    share = parts / np.where(total > 0, total, 1.0)
    at = share[0] * ~nothing
    variance = (at * (z - stars) ** 2).sum() / max(at.sum(), 1e-12)
    weights = share.mean(axis=1) / max(share.mean(axis=1).sum(), 1e-12)
    length = (share[1] * z).sum() / max(share[1].sum(), 1e-12)
    scales = max(np.sqrt(variance), _LEAST), 1 / max(length, _LEAST)
    return Mixture(*(float(value) for value in (*weights, *scales)))
