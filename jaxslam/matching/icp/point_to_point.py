"""The iterative closest point method with distances between points."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.core.record import record
from jaxslam.matching.icp.closed_form import Quadratic, of_points
from jaxslam.matching.icp.iterations import Icp, IcpSettings, PairedPoints
from jaxslam.matching.surface import Surface


@record
class PointToPoint(Icp):
    """ICP: the pose that minimizes Σ w |T ∘ p_i - q_j(i)|², q_j(i) the nearest point.

    Each step is the exact minimum for its pairs (`closed_form.least`); its error falls by a
    constant factor a step. Besl & McKay 1992, "A method for registration of 3-D shapes", IEEE
    PAMI 14; Lu & Milios 1997. Lines serve the status alone.
    """

    settings: IcpSettings = IcpSettings()

    def residual(self, of: Surface, moved: Array, partner: Array) -> Float[Array, "N"]:
        return distance(of, moved, partner)

    def quadratic(self, of: Surface, pairs: PairedPoints, middle: Array) -> Quadratic:
        used = (pairs.weight > 0)[:, None]
        source = jnp.where(used, pairs.moved - middle[None], 0.0)
        target = jnp.where(used, of.position[pairs.partner] - middle[None], 0.0)
        return of_points(source, target, pairs.weight)

    def cost_of_pairs(
        self, of: Surface, moved: Array, partner: Array, weight: Array
    ) -> Float[Array, ""]:
        apart = jnp.where((weight > 0)[:, None], moved - of.position[partner], 0.0)
        return 0.5 * (weight * (apart**2).sum(axis=1)).sum()


def distance(of: Surface, moved: Array, partner: Array) -> Float[Array, "N"]:
    """The distance [m] of each point from its partner."""
    square = ((moved - of.position[partner]) ** 2).sum(axis=1)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
