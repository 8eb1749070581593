"""The iterative closest point method with distances between points."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.graphs.solver.kernels import Kernel
from jaxslam.matching.closed_form import align_points
from jaxslam.matching.icp import Metric, Pairs, icp
from jaxslam.matching.matcher import Matcher
from jaxslam.matching.outcome import Limits
from jaxslam.matching.surface import Surface


def point_to_point(
    *,
    reach: float = 0.5,
    trim: float = 1.0,
    kernel: Kernel | None = None,
    scale: float = 0.1,
    span: int = 5,
    gap: float = 0.5,
    iterations: int = 200,
    tolerance: float = 1e-6,
    fewest: int = 10,
    least_score: float = 0.5,
    least_condition: float = 0.01,
) -> Matcher:
    """ICP: the pose that minimizes Σ w |T ∘ p_i - q_j(i)|², q_j(i) the nearest point.

    Each step is `closed_form.align_points`; its error falls by a constant factor a step.
    Besl & McKay 1992, "A method for registration of 3-D shapes", IEEE PAMI 14; Lu & Milios 1997.
    The arguments are those of `point_to_line`; lines serve the status alone.
    """
    metric = Metric(_distance, _there, _step, _cost)
    limits = Limits(fewest, least_score, least_condition)
    return icp(
        "point_to_point",
        metric,
        reach=reach,
        trim=trim,
        kernel=kernel,
        scale=scale,
        span=span,
        gap=gap,
        iterations=iterations,
        tolerance=tolerance,
        limits=limits,
    )


def _distance(of: Surface, moved: Array, partner: Array) -> Float[Array, "N"]:
    square = ((moved - of.position[partner]) ** 2).sum(axis=1)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def _there(of: Surface) -> Array:
    return jnp.ones(of.straight.shape, bool)


def _step(of: Surface, pairs: Pairs, middle: Array) -> Float[Array, "3"]:
    target = of.position[pairs.partner] - middle[None]
    used = pairs.weight > 0
    return align_points(
        pairs.moved - middle[None], jnp.where(used[:, None], target, 0.0), pairs.weight
    )


def _cost(of: Surface, moved: Array, partner: Array, weight: Array) -> Float[Array, ""]:
    apart = jnp.where((weight > 0)[:, None], moved - of.position[partner], 0.0)
    return 0.5 * (weight * (apart**2).sum(axis=1)).sum()
