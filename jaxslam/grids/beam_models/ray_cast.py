"""The range of a beam against the one that the map predicts: a mixture of four components."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from jaxslam.core.numbers import check_mount, check_positive, is_concrete
from jaxslam.grids.beam_models.beam_model import BeamModel
from jaxslam.grids.cast import RayMap, cast, check_method, ray_map
from jaxslam.grids.grid import Grid
from jaxslam.math import se2
from jaxslam.types import Beams


class Mixture(NamedTuple):
    """The parameters of `ray_cast`."""

    hit: ArrayLike
    """share of beams that end at the obstacle of the map, with Gaussian noise"""
    short: ArrayLike
    """share that ends earlier, at what the map does not have"""
    maximum: ArrayLike
    """share that returns nothing, and so max_range"""
    random: ArrayLike
    """share of any range"""
    sigma: ArrayLike
    """standard deviation of a hit [m]"""
    rate: ArrayLike
    """rate λ of the exponential density of short ones [1/m]"""


USUAL = Mixture(0.75, 0.1, 0.05, 0.1, 0.1, 0.5)
"""Parameters of a laser in a building whose map is good."""


def mixture_log_density(
    mixture: Mixture, z: Float[Array, "*n"], expected: Float[Array, "*n"], max_range: float
) -> Float[Array, "*n"]:
    """The log-density of ranges z given those expected: a density below max_range, a mass there.

    Below max_range: hit · N(z; z*, σ²)/Φ + short · λ exp(-λ z)/(1 - exp(-λ z*)) [z <= z*]
    + random/max_range, Φ the mass of the normal within [0, max_range]. At max_range: maximum, and
    with it the hit where max_range is expected, since there is nothing to hit. Integral and mass
    sum to 1.

    Thrun, Burgard & Fox 2005, "Probabilistic robotics", (6.4) to (6.12).
    """
    hit, short, maximum, random, sigma, rate = (jnp.asarray(value) for value in mixture)
    nothing = expected >= max_range
    star = jnp.where(nothing, 0.5 * max_range, expected)
    mass = ndtr((max_range - star) / sigma) - ndtr(-star / sigma)
    normal = jnp.exp(-0.5 * ((z - star) / sigma) ** 2) / (sigma * math.sqrt(2 * math.pi) * mass)
    # Where max_range is expected, short ones are spread over all of it.
    end = jnp.where(nothing, max_range, jnp.maximum(expected, 1e-6))
    early = jnp.where(z <= end, rate * jnp.exp(-rate * z) / -jnp.expm1(-rate * end), 0.0)
    near = jnp.where(nothing, 0.0, hit * normal) + short * early + random / max_range
    far = maximum + jnp.where(nothing, hit, 0.0)
    least = jnp.finfo(jnp.result_type(z, float)).tiny
    return jnp.log(jnp.maximum(jnp.where(z >= max_range, far, near), least))


def density_slope(
    mixture: Mixture, z: Float[Array, "*n"], expected: Float[Array, "*n"], max_range: float
) -> Float[Array, "*n"]:
    """The derivative of `mixture_log_density` by the expected range z*, by hand.

    With N the hit, Φ its mass and φ the normal density: ∂(N/Φ) = (N/Φ) ((z - z*)/σ² - ∂Φ/Φ),
    ∂Φ = (φ(-z*/σ) - φ((z_max - z*)/σ))/σ; the short ones E = λ exp(-λ z)/(1 - exp(-λ z*)) have
    ∂E = -E λ exp(-λ z*)/(1 - exp(-λ z*)). 0 at max_range, and where max_range is expected.
    """
    hit, short, _, random, sigma, rate = (jnp.asarray(value) for value in mixture)
    star = jnp.minimum(jnp.maximum(expected, 1e-6), max_range)
    low, high = -star / sigma, (max_range - star) / sigma
    mass = ndtr(high) - ndtr(low)
    by_mass = (jnp.exp(-0.5 * low**2) - jnp.exp(-0.5 * high**2)) / (sigma * math.sqrt(2 * math.pi))
    normal = jnp.exp(-0.5 * ((z - star) / sigma) ** 2) / (sigma * math.sqrt(2 * math.pi) * mass)
    rest = -jnp.expm1(-rate * star)
    early = jnp.where(z <= star, rate * jnp.exp(-rate * z) / rest, 0.0)
    near = hit * normal + short * early + random / max_range
    rise = hit * normal * ((z - star) / sigma**2 - by_mass / mass)
    rise = rise - short * early * rate * jnp.exp(-rate * star) / rest
    known = (z < max_range) & (expected < max_range) & (near > 0)
    return jnp.where(known, rise / jnp.where(near > 0, near, 1.0), 0.0)


def ray_cast(
    mixture: Mixture = USUAL,
    *,
    max_range: float,
    method: str | None = None,
    mount: ArrayLike | tuple[float, ...] = (0.0, 0.0, 0.0),
) -> BeamModel:
    """The ray-cast model: `mixture_log_density` of each range given that of `grids.cast`.

    Differentiable by the parameters, and by the pose in the sense of `cast`, with either method.

    Args:
        mixture: parameters, which `fit` learns from data; the four shares have sum 1.
        max_range: [m]. method: of `ray_map`; None chooses by the map.
        mount: (3,) pose of the laser on the robot.
    Raises:
        ValueError: numbers out of range, an unknown method, a mount that is no pose.
    """
    check_positive("ray_cast", max_range=max_range, sigma=mixture.sigma, rate=mixture.rate)
    if method is not None:
        check_method("ray_cast", method)
    check_mount("ray_cast", mount)
    check_weights("ray_cast", dict(zip(Mixture._fields[:4], mixture[:4], strict=True)))

    def prepare(grid: Grid) -> RayMap:
        return ray_map(grid, method=method)

    def each(rays: PyTree, pose: Array, beams: Beams) -> Float[Array, "B"]:
        eye = se2.compose(pose, jnp.asarray(mount, pose.dtype))
        expected = cast(rays, eye, beams.angle, max_range)
        z = jnp.where(beams.returns(max_range)[1], max_range, beams.range)
        return mixture_log_density(mixture, z, expected, max_range)

    def jacobian(rays: PyTree, pose: Array, beams: Beams) -> Float[Array, "B 3"]:
        """The derivative by z*, times that of z*, for which `cast` has its own rule."""
        frame = jnp.asarray(mount, pose.dtype)

        def expected_at(pose: Array) -> Float[Array, "B"]:
            return cast(rays, se2.compose(pose, frame), beams.angle, max_range)

        expected, by_pose = expected_at(pose), jax.jacfwd(expected_at)(pose)
        z = jnp.where(beams.returns(max_range)[1], max_range, beams.range)
        by_range: Array = density_slope(mixture, z, expected, max_range)
        return by_range[:, None] * jnp.asarray(by_pose)

    return BeamModel("ray_cast", prepare, each, jacobian, mount)


def check_weights(name: str, weights: dict[str, ArrayLike]) -> None:
    """Raise ValueError unless the shares of a mixture are >= 0 and have sum 1."""
    if not is_concrete(weights):
        return
    values = np.array([float(np.asarray(value)) for value in weights.values()])
    if np.any(values < 0) or not abs(values.sum() - 1) < 1e-6:
        told = ", ".join(f"{key} {value:g}" for key, value in zip(weights, values, strict=True))
        raise ValueError(f"{name}: expected shares >= 0 of sum 1, got {told}")
