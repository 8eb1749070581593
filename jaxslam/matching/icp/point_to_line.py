"""The iterative closest point method with distances from points to lines (PL-ICP)."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam.core.record import record
from jaxslam.matching.icp.closed_form import Quadratic, added, of_lines, of_points
from jaxslam.matching.icp.iterations import Icp, IcpSettings, PairedPoints
from jaxslam.matching.icp.point_to_point import distance
from jaxslam.matching.surface import Surface


@record
class PointToLine(Icp):
    """PL-ICP: the pose that minimizes Σ w (n_j · (T ∘ p_i - m_j))², j(i) the nearest point.

    The line (m_j, n_j) is fitted to point j of the reference and its neighbours (`Surface`); each
    step is the exact minimum for its pairs (`closed_form.least`), so that it converges
    quadratically. Censi 2008, "An ICP variant using a point-to-line metric", ICRA, where the line
    joins the two nearest points. Where there is no line, the residual is `lone` |T ∘ p_i - q_j|.
    """

    settings: IcpSettings = IcpSettings()

    def residual(self, of: Surface, moved: Array, partner: Array) -> Float[Array, "N"]:
        across = (of.normal[partner] * (moved - of.middle[partner])).sum(axis=1)
        lone = self.settings.lone
        if lone is None:
            return across
        return jnp.where(of.straight[partner], across, lone * distance(of, moved, partner))

    def usable(self, of: Surface) -> Bool[Array, "M"]:
        return of.straight if self.settings.lone is None else super().usable(of)

    def quadratic(self, of: Surface, pairs: PairedPoints, middle: Array) -> Quadratic:
        j, lone = pairs.partner, self.settings.lone
        by_line, by_point = _weights(of, j, pairs.weight)

        def about(points: Array, weight: Array) -> Array:
            return jnp.where((weight > 0)[:, None], points - middle[None], 0.0)

        source = about(pairs.moved, pairs.weight)
        lines = of_lines(source, about(of.middle[j], by_line), of.normal[j], by_line)
        if lone is None:
            return lines
        points = of_points(source, about(of.position[j], by_point), lone**2 * by_point)
        return added(lines, points)

    def cost_of_pairs(
        self, of: Surface, moved: Array, partner: Array, weight: Array
    ) -> Float[Array, ""]:
        by_line, by_point = _weights(of, partner, weight)
        apart = jnp.where((by_line > 0)[:, None], moved - of.middle[partner], 0.0)
        total = (by_line * (of.normal[partner] * apart).sum(axis=1) ** 2).sum()
        lone = self.settings.lone
        if lone is not None:
            apart = jnp.where((by_point > 0)[:, None], moved - of.position[partner], 0.0)
            total = total + lone**2 * (by_point * (apart**2).sum(axis=1)).sum()
        return 0.5 * total


def _weights(of: Surface, partner: Array, weight: Array) -> tuple[Array, Array]:
    """The weights of pairs with a line, and of those without."""
    straight = of.straight[partner]
    return jnp.where(straight, weight, 0.0), jnp.where(straight, 0.0, weight)
