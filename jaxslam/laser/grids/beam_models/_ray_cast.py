"""The range of a beam against the one that the map predicts: a mixture of four components, and the
fit of its parameters to measured ranges.
"""

import dataclasses
import math
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from jaxslam.core._numbers import is_concrete
from jaxslam.core._record import field, record, static
from jaxslam.core.types import Beams
from jaxslam.core.validation import (
    InvalidField,
    instance_of,
    mounting_pose,
    one_of,
    or_none,
    positive,
    refusals_of,
    require,
)
from jaxslam.laser.grids._grid import Grid
from jaxslam.laser.grids._rays import METHODS, RayMap, cast, ray_map
from jaxslam.laser.grids.beam_models._beam_model import BeamModel
from jaxslam.math._arrays import Number


class Mixture(NamedTuple):
    """The parameters of `RayCast`."""

    hit: Number
    """share of beams that end at the obstacle of the map, with Gaussian noise"""
    short: ArrayLike
    """share that ends earlier, at objects that the map does not have"""
    maximum: Number
    """share that returns nothing, and so max_range"""
    random: Number
    """share of any range"""
    sigma: Number
    """standard deviation of a hit [m]"""
    rate: ArrayLike
    """rate λ of the exponential density of short ones [1/m]"""


_USUAL = Mixture(0.75, 0.1, 0.05, 0.1, 0.1, 0.5)
"""Parameters of a laser in a building whose map is good (chosen)."""
_LEAST_RANGE = 1e-6
"""[m] least expected range: of 0 the density of short ranges has no limit."""


def mixture_log_density(
    mixture: Mixture, z: Float[Array, "*n"], expected: Float[Array, "*n"], max_range: Number
) -> Float[Array, "*n"]:
    """The log-density of ranges z given those expected: a density below max_range, a mass there.

    Below max_range: hit · N(z; z*, σ²)/Φ + short · λ exp(-λ z)/(1 - exp(-λ z*)) [z <= z*]
    + random/max_range, Φ the mass of the normal within [0, max_range]. At max_range: maximum, and
    with it the hit where max_range is expected, because nothing can be hit. Integral and mass
    sum to 1.

    Thrun, Burgard & Fox 2005, "Probabilistic robotics", (6.4) to (6.12).
    """
    hit, short, maximum, random, sigma, rate = (jnp.asarray(value) for value in mixture)
    nothing = expected >= max_range
    star = jnp.where(nothing, 0.5 * max_range, expected)  # any: its mass must not vanish
    mass = ndtr((max_range - star) / sigma) - ndtr(-star / sigma)
    normal = jnp.exp(-0.5 * ((z - star) / sigma) ** 2) / (sigma * math.sqrt(2 * math.pi) * mass)
    # Where max_range is expected, short ones are spread over all of it.
    end = jnp.where(nothing, max_range, jnp.maximum(expected, _LEAST_RANGE))
    early = jnp.where(z <= end, rate * jnp.exp(-rate * z) / -jnp.expm1(-rate * end), 0.0)
    near = jnp.where(nothing, 0.0, hit * normal) + short * early + random / max_range
    far = maximum + jnp.where(nothing, hit, 0.0)
    least = jnp.finfo(jnp.result_type(z, float)).tiny
    return jnp.log(jnp.maximum(jnp.where(z >= max_range, far, near), least))


def _density_slope(
    mixture: Mixture, z: Float[Array, "*n"], expected: Float[Array, "*n"], max_range: Number
) -> Float[Array, "*n"]:
    """The derivative of `mixture_log_density` by the expected range z*, by hand.

    With N the hit, Φ its mass and φ the normal density: ∂(N/Φ) = (N/Φ) ((z - z*)/σ² - ∂Φ/Φ),
    ∂Φ = (φ(-z*/σ) - φ((z_max - z*)/σ))/σ; the short ones E = λ exp(-λ z)/(1 - exp(-λ z*)) have
    ∂E = -E λ exp(-λ z*)/(1 - exp(-λ z*)). 0 at max_range, and where max_range is expected.
    """
    hit, short, _, random, sigma, rate = (jnp.asarray(value) for value in mixture)
    star = jnp.minimum(jnp.maximum(expected, _LEAST_RANGE), max_range)
    low, high = -star / sigma, (max_range - star) / sigma
    mass = ndtr(high) - ndtr(low)
    by_mass = (jnp.exp(-0.5 * low**2) - jnp.exp(-0.5 * high**2)) / (sigma * math.sqrt(2 * math.pi))
    normal = jnp.exp(-0.5 * ((z - star) / sigma) ** 2) / (sigma * math.sqrt(2 * math.pi) * mass)
    short_mass = -jnp.expm1(-rate * star)
    early = jnp.where(z <= star, rate * jnp.exp(-rate * z) / short_mass, 0.0)
    near = hit * normal + short * early + random / max_range
    rise = hit * normal * ((z - star) / sigma**2 - by_mass / mass)
    rise = rise - short * early * rate * jnp.exp(-rate * star) / short_mass
    has_slope = (z < max_range) & (expected < max_range) & (near > 0)
    return jnp.where(has_slope, rise / jnp.where(near > 0, near, 1.0), 0.0)


def check_weights(weights: dict[str, ArrayLike]) -> None:
    """Raise InvalidField unless the shares of a mixture are >= 0 and have sum 1."""
    if not is_concrete(weights):
        return
    values = np.array([float(np.asarray(value)) for value in weights.values()])
    if np.any(values < 0) or not abs(values.sum() - 1) < 1e-6:
        listed = ", ".join(f"{key} {value:g}" for key, value in zip(weights, values, strict=True))
        raise InvalidField("", f"expected shares >= 0 of sum 1, got {listed}")


def _mixture_of_shares(value: Any) -> Mixture:
    """The check of a mixture: shares of sum 1, and a deviation and a rate above 0."""
    mixture: Mixture = instance_of(Mixture)(value)
    require("sigma", mixture.sigma, positive)
    require("rate", mixture.rate, positive)
    check_weights(dict(zip(Mixture._fields[:4], mixture[:4], strict=True)))
    return mixture


@record
class RayCast(BeamModel):
    """The ray-cast model: `mixture_log_density` of each range given that of `grids.cast`.

    Differentiable by the parameters, and by the pose in the sense of `cast`, with either method.

    Raises ValueError on numbers out of range, an unknown method, an invalid mount.
    """

    mixture: Mixture = field(default=_USUAL, check=_mixture_of_shares)
    """parameters, which `fit` learns from data; the four shares have sum 1"""
    _: dataclasses.KW_ONLY
    max_range: Number = field(check=positive)
    """[m]"""
    method: str | None = static(default=None, check=or_none(one_of(*METHODS)))
    """of `ray_map`; None chooses by the map"""
    mount: ArrayLike | None = field(default=None, check=or_none(mounting_pose))
    """(3,) pose of the laser on the robot"""

    def prepare(self, grid: Grid) -> RayMap:
        return ray_map(grid, method=self.method)

    def log_likelihoods(self, prepared: PyTree, pose: Array, beams: Beams) -> Float[Array, "B"]:
        expected = self._expected_range(prepared, pose, beams)
        far = jnp.asarray(self.max_range, expected.dtype)
        z = jnp.where(beams.returns(far)[1], far, beams.range)
        return mixture_log_density(self.mixture, z, expected, far)

    def jacobian(self, prepared: PyTree, pose: Array, beams: Beams) -> Float[Array, "B 3"]:
        """The derivative by z* times the derivative of z*, for which `cast` has a custom rule."""
        expected = self._expected_range(prepared, pose, beams)
        by_pose = jax.jacfwd(lambda pose: self._expected_range(prepared, pose, beams))(pose)
        far = jnp.asarray(self.max_range, expected.dtype)
        z = jnp.where(beams.returns(far)[1], far, beams.range)
        by_range: Array = _density_slope(self.mixture, z, expected, far)
        return by_range[:, None] * jnp.asarray(by_pose)

    def _expected_range(self, rays: PyTree, pose: Array, beams: Beams) -> Float[Array, "B"]:
        return cast(rays, self.frame(pose), beams.angle, self.max_range)


START = Mixture(0.6, 0.15, 0.1, 0.15, 0.2, 0.5)
"""Parameters where the search begins (chosen: each component has a share)."""
_LEAST = 1e-6
"""Least σ [m] and length 1/λ [m]: exact ranges have a σ of 0, whose density has no limit."""


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
    with refusals_of("fit"):
        if ranges.ndim != 1 or ranges.shape != stars.shape or len(ranges) == 0:
            raise InvalidField(
                "z",
                "expected at least one range, and as many as expected ones, got "
                f"{ranges.shape} and {stars.shape}",
            )
        require("start", start, _mixture_of_shares)
        require("max_range", max_range, positive)
        if not np.all(np.isfinite(stars)) or stars.min() < 0:
            raise InvalidField("expected", "expected ranges that are finite and not below 0")
        met, far = Beams(ranges, np.zeros_like(ranges), np.ones(len(ranges), bool)).returns(
            max_range
        )
        if not (met | far).any():
            raise InvalidField("z", f"none of {len(ranges)} ranges is above 0")
        require("method", method, one_of("gradient", "em"))
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

    # By logarithms shares, σ and λ stay above 0 without bounds; a share of 0 begins at 1e-6.
    first = np.log(np.maximum([float(np.asarray(value)) for value in start], 1e-6))
    optimum = minimize(cost, first, jac=True, method="BFGS", options={"maxiter": iterations})
    return Mixture(*(float(np.asarray(value)) for value in _mixture(jnp.asarray(optimum.x))))


def _mixture(x: Float[Array, "6"]) -> Mixture:
    """The mixture of logarithms of shares, up to a constant, and of σ and λ."""
    shares, scales = jax.nn.softmax(x[:4]), _LEAST + jnp.exp(x[4:])
    return Mixture(shares[0], shares[1], shares[2], shares[3], scales[0], scales[1])


@jax.jit
def _cost_and_slope(x: Array, z: Array, stars: Array, max_range: Array) -> tuple[Array, Array]:
    def cost(x: Array) -> Array:
        return -mixture_log_density(_mixture(x), z, stars, max_range).mean()

    return jax.value_and_grad(cost)(x)


def _em_step(mixture: Mixture, z: np.ndarray, stars: np.ndarray, max_range: float) -> Mixture:
    """The mixture by the responsibilities of its four components for each range."""
    hit, short, maximum, random, sigma, rate = (float(np.asarray(value)) for value in mixture)
    far, nothing = z >= max_range, stars >= max_range
    normal = np.exp(-0.5 * ((z - stars) / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))
    end = np.maximum(stars, _LEAST_RANGE)
    early = np.where(z <= end, rate * np.exp(-rate * z) / -np.expm1(-rate * end), 0.0)
    densities = np.stack(
        [
            hit * np.where(nothing, far, np.where(far, 0.0, normal)),
            short * np.where(far, 0.0, early),
            maximum * far,
            random * np.where(far, 0.0, 1 / max_range),
        ]
    )
    total = densities.sum(axis=0)
    # Responsibilities; a range that no component can make, of density 0, has none.
    share = densities / np.where(total > 0, total, 1.0)
    # Where max_range is expected, a hit says nothing on σ.
    at = share[0] * ~nothing
    variance = (at * (z - stars) ** 2).sum() / max(at.sum(), 1e-12)
    weights = share.mean(axis=1) / max(share.mean(axis=1).sum(), 1e-12)
    length = (share[1] * z).sum() / max(share[1].sum(), 1e-12)
    scales = max(np.sqrt(variance), _LEAST), 1 / max(length, _LEAST)
    return Mixture(*(float(value) for value in (*weights, *scales)))
