"""The noise of the ranges through the condition that the match is a minimum (Censi 2007)."""

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxslam.core.record import record
from jaxslam.matching.covariance.record import (
    MatchCovariance,
    MatchedScans,
    curvature,
    propagated,
    range_count,
    with_ranges,
)
from jaxslam.matching.matcher import Matcher
from jaxslam.matching.points import Points, moved_along_rays


@record
class Implicit(MatchCovariance):
    """The covariance A⁻¹ B σ² Bᵀ A⁻¹, A = ∂²E/∂x², B = ∂²E/∂x∂z, with the ranges z of both scans.

    From ∂E/∂x = 0 at the minimum: dx/dz = -(∂²E/∂x²)⁻¹ ∂²E/∂z∂x. The derivatives are those of the
    matcher's cost by automatic differentiation, through the lines that are fitted to the reference;
    pairs and weights are kept. Of a grid only the noise of the scan counts. A prior adds the noise
    of its pose, σ² Λ in the middle.
    Where pairs follow the scan, as those of point-to-point along a wall, keeping them feigns
    information (Bonnabel et al. 2016; see `AlongNormals`).

    Censi 2007, "An accurate closed-form estimate of ICP's covariance", ICRA.
    """

    sigma: ArrayLike
    """standard deviation of a range [m]"""

    def of_usable(self, matcher: Matcher, scans: MatchedScans) -> Float[Array, "3 3"]:
        reference, points, found, *_ = scans
        prepared = matcher.prepare(reference)

        def slope(of_reference: Array, of_scan: Array) -> Array:
            changed = with_ranges(reference, of_reference)
            there = matcher.prepare(changed) if isinstance(reference, Points) else prepared
            moved = moved_along_rays(points, of_scan)
            by_pose: Array = jax.grad(lambda pose: matcher.cost(there, moved, pose, found))(
                found.pose
            )
            return by_pose

        dtype = points.position.dtype
        zeros = jnp.zeros(range_count(reference), dtype), jnp.zeros(len(points.valid), dtype)
        by_ranges = jnp.concatenate(jax.jacrev(slope, argnums=(0, 1))(*zeros), axis=1)
        shape = curvature(matcher, prepared, points, found)
        return propagated(found, shape, by_ranges @ by_ranges.T, self.sigma)
