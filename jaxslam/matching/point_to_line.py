"""The iterative closest point method with distances from points to lines (PL-ICP)."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam.matching.closed_form import Quadratic, of_lines
from jaxslam.matching.icp import IcpSettings, Metric, Pairs, icp
from jaxslam.matching.matcher import Matcher
from jaxslam.matching.surface import Surface


DEFAULT = IcpSettings()


def point_to_line(settings: IcpSettings = DEFAULT) -> Matcher:
    """PL-ICP: the pose that minimizes Σ w (n_j · (T ∘ p_i - m_j))², j(i) the nearest point.

    The line (m_j, n_j) is fitted to point j of the reference and its neighbours (`Surface`); each
    step is the exact minimum for its pairs (`closed_form.least`), so that it converges
    quadratically. Censi 2008, "An ICP variant using a point-to-line metric", ICRA, where the line
    joins the two nearest points.
    """
    return icp("point_to_line", Metric(_across, _straight, _quadratic, _cost), settings)


def _straight(of: Surface) -> Bool[Array, "M"]:
    return of.straight


def _across(of: Surface, moved: Array, partner: Array) -> Float[Array, "N"]:
    return (of.normal[partner] * (moved - of.middle[partner])).sum(axis=1)


def _quadratic(of: Surface, pairs: Pairs, middle: Array) -> Quadratic:
    j, used = pairs.partner, (pairs.weight > 0)[:, None]
    source = jnp.where(used, pairs.moved - middle[None], 0.0)
    target = jnp.where(used, of.middle[j] - middle[None], 0.0)
    return of_lines(source, target, of.normal[j], pairs.weight)


def _cost(of: Surface, moved: Array, partner: Array, weight: Array) -> Float[Array, ""]:
    used = weight > 0
    apart = jnp.where(used[:, None], moved - of.middle[partner], 0.0)
    return 0.5 * (weight * (of.normal[partner] * apart).sum(axis=1) ** 2).sum()
