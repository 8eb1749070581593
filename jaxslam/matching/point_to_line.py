"""The iterative closest point method with distances from points to lines (PL-ICP)."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.graphs.solver.kernels import Kernel
from jaxslam.matching.closed_form import align_to_lines
from jaxslam.matching.icp import Metric, Pairs, icp
from jaxslam.matching.matcher import Matcher
from jaxslam.matching.outcome import Limits
from jaxslam.matching.surface import Surface


def point_to_line(
    *,
    reach: float = 0.5,
    trim: float = 1.0,
    kernel: Kernel | None = None,
    scale: float = 0.1,
    span: int = 5,
    gap: float = 0.5,
    iterations: int = 50,
    tolerance: float = 1e-6,
    fewest: int = 10,
    least_score: float = 0.5,
    least_condition: float = 0.01,
) -> Matcher:
    """PL-ICP: the pose that minimizes Σ w (n_j · (T ∘ p_i - m_j))², j(i) the nearest point.

    The line (m_j, n_j) is fitted to point j of the reference and its neighbours (`Surface`); each
    step is the exact minimum for its pairs (`closed_form.align_to_lines`), so that it converges
    quadratically. Censi 2008, "An ICP variant using a point-to-line metric", ICRA, where the line
    joins the two nearest points.

    Args:
        reach: largest distance of partners [m].
        trim: share of the pairs that is kept at each step, those of the smallest residuals.
        kernel: robust, as `graphs.huber()`, of (residual/scale)²; None for squares.
        scale: [m] of the kernel and of `Match.score`.
        span: neighbours on each side that a line is fitted to.
        gap: [m] between points beyond which they are not neighbours.
        iterations: at most.
        tolerance: of convergence: the motion of a step [m], angles times the RMS range.
        fewest, least_score, least_condition: below these numbers of pairs, of `Match.score` and of
            `Match.condition` the status is TOO_FEW, UNLIKE or DEGENERATE.
    Raises:
        ValueError: a number out of range.
    """
    metric = Metric(_across, lambda of: of.straight, _step, _cost)
    limits = Limits(fewest, least_score, least_condition)
    return icp(
        "point_to_line",
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


def _across(of: Surface, moved: Array, partner: Array) -> Float[Array, "N"]:
    return (of.normal[partner] * (moved - of.middle[partner])).sum(axis=1)


def _step(of: Surface, pairs: Pairs, middle: Array) -> Float[Array, "3"]:
    j, used = pairs.partner, (pairs.weight > 0)[:, None]
    source = jnp.where(used, pairs.moved - middle[None], 0.0)
    target = jnp.where(used, of.middle[j] - middle[None], 0.0)
    return align_to_lines(source, target, of.normal[j], pairs.weight)


def _cost(of: Surface, moved: Array, partner: Array, weight: Array) -> Float[Array, ""]:
    used = weight > 0
    apart = jnp.where(used[:, None], moved - of.middle[partner], 0.0)
    return 0.5 * (weight * (of.normal[partner] * apart).sum(axis=1) ** 2).sum()
