"""The iterative closest point method with distances from points to lines (PL-ICP)."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam.matching.icp.closed_form import Quadratic, added, of_lines, of_points
from jaxslam.matching.icp.iterations import DEFAULT, IcpSettings, Metric, PairedPoints, icp
from jaxslam.matching.matcher import Matcher
from jaxslam.matching.surface import Surface


def point_to_line(settings: IcpSettings = DEFAULT) -> Matcher:
    """PL-ICP: the pose that minimizes Σ w (n_j · (T ∘ p_i - m_j))², j(i) the nearest point.

    The line (m_j, n_j) is fitted to point j of the reference and its neighbours (`Surface`); each
    step is the exact minimum for its pairs (`closed_form.least`), so that it converges
    quadratically. Censi 2008, "An ICP variant using a point-to-line metric", ICRA, where the line
    joins the two nearest points. Where there is no line, the residual is `lone` |T ∘ p_i - q_j|.
    """
    lone = settings.lone

    def residual(of: Surface, moved: Array, partner: Array) -> Float[Array, "N"]:
        across = (of.normal[partner] * (moved - of.middle[partner])).sum(axis=1)
        if lone == 0:
            return across
        square = ((moved - of.position[partner]) ** 2).sum(axis=1)
        distance = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
        return jnp.where(of.straight[partner], across, lone * distance)

    def usable(of: Surface) -> Bool[Array, "M"]:
        return of.straight if lone == 0 else jnp.ones_like(of.straight)

    def quadratic(of: Surface, pairs: PairedPoints, middle: Array) -> Quadratic:
        j = pairs.partner
        by_line, by_point = _weights(of, j, pairs.weight)

        def about(points: Array, weight: Array) -> Array:
            return jnp.where((weight > 0)[:, None], points - middle[None], 0.0)

        source = about(pairs.moved, pairs.weight)
        lines = of_lines(source, about(of.middle[j], by_line), of.normal[j], by_line)
        if lone == 0:
            return lines
        points = of_points(source, about(of.position[j], by_point), lone**2 * by_point)
        return added(lines, points)

    def cost(of: Surface, moved: Array, partner: Array, weight: Array) -> Float[Array, ""]:
        by_line, by_point = _weights(of, partner, weight)
        apart = jnp.where((by_line > 0)[:, None], moved - of.middle[partner], 0.0)
        total = (by_line * (of.normal[partner] * apart).sum(axis=1) ** 2).sum()
        if lone != 0:
            apart = jnp.where((by_point > 0)[:, None], moved - of.position[partner], 0.0)
            total = total + lone**2 * (by_point * (apart**2).sum(axis=1)).sum()
        return 0.5 * total

    return icp("point_to_line", Metric(residual, usable, quadratic, cost), settings)


def _weights(of: Surface, partner: Array, weight: Array) -> tuple[Array, Array]:
    """The weights of pairs with a line, and of those without."""
    straight = of.straight[partner]
    return jnp.where(straight, weight, 0.0), jnp.where(straight, 0.0, weight)
