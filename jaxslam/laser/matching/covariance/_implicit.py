"""Covariances of a match from derivatives of its cost at the minimum.

`Implicit` carries the noise of the ranges through the condition that the match is a minimum (Censi
2007), `Hessian` is the inverse second derivative, and `AlongNormals` the closed form with residuals
across the surface alone (Bonnabel, Barczyk & Goulette 2016).
"""

import dataclasses

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxslam.core._record import field, record, static
from jaxslam.core.validation import (
    at_least,
    instance_of,
    positive,
    refusals_of,
    require,
)
from jaxslam.laser.matching._matcher import Matcher
from jaxslam.laser.matching._outcome import information_of
from jaxslam.laser.matching._point_sets import Points, move_along_rays
from jaxslam.laser.matching._surfaces import GAP, SPAN, surface
from jaxslam.laser.matching.covariance._match_covariance import (
    MatchCovariance,
    MatchedScans,
    add_prior,
    change_ranges,
    curvature,
    inverse_of,
    noise_cov,
    range_count,
)
from jaxslam.math import se2
from jaxslam.math._arrays import Number


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
        reference, points, match, *_ = scans
        prepared = matcher.prepare(reference)

        def slope(reference_change: Array, scan_change: Array) -> Array:
            """∂E/∂x as a function of changes of the ranges."""
            changed = change_ranges(reference, reference_change)
            changed_prepared = (
                matcher.prepare(changed) if isinstance(reference, Points) else prepared
            )
            moved = move_along_rays(points, scan_change)
            by_pose: Array = jax.grad(
                lambda pose: matcher.cost(changed_prepared, moved, pose, match)
            )(match.pose)
            return by_pose

        # At no change: the derivatives by the ranges of the reference and of the scan.
        dtype = points.position.dtype
        zeros = jnp.zeros(range_count(reference), dtype), jnp.zeros(len(points.valid), dtype)
        by_ranges = jnp.concatenate(jax.jacrev(slope, argnums=(0, 1))(*zeros), axis=1)
        shape = curvature(matcher, prepared, points, match)
        return noise_cov(match, shape, by_ranges @ by_ranges.T, self.sigma)


@record
class Hessian(MatchCovariance):
    """The covariance s² (∂²E/∂x²)⁻¹, E = ½ Σ w e², s² = 2E/(n - 3) of n pairs; 2E/n with a prior.

    Right for independent residuals of one variance that the pairs do not follow. Two scans of
    different density, and pairs that change with the pose, break that.
    Bengtsson & Baerveldt 2003, "Robot localization based on scan-matching: estimating the
    covariance matrix for the IDC algorithm", Robotics and Autonomous Systems 44.
    """

    def of_usable(self, matcher: Matcher, scans: MatchedScans) -> Float[Array, "3 3"]:
        reference, points, match, *_ = scans
        prepared = matcher.prepare(reference)
        # With a prior the pose is no free parameter of the residuals.
        free = (match.weight > 0).sum() - (3 if match.prior is None else 0)
        free = jnp.maximum(free, 1).astype(match.weight.dtype)
        least = 2 * matcher.cost(prepared, points, match.pose, match) / free
        shape = curvature(matcher, prepared, points, match)
        return least * inverse_of(shape, add_prior(match, match.information))


@record
class AlongNormals(MatchCovariance):
    """The covariance A⁻¹ B A⁻¹, A = Σ w J Jᵀ, J = (n, n·∂(R p)/∂θ), B the noise of Σ w J e.

    A scan that slides along a wall finds other partners, so that the part of a residual along the
    wall has no information: the second derivative of point-to-point with fixed pairs counts it as
    information, whatever the noise. Across the wall a change of partner matters to second order
    only (Bonnabel, Barczyk & Goulette 2016, "On the covariance of ICP-based scan-matching
    techniques", ACC). Hence n alone, for both ICPs. A range of the scan moves its residual by n·Ru,
    u the beam; one of the reference those of all its partners by -n·u:

        B = σ² (Σ_i w_i² (n·R u_i)² J_i J_iᵀ + Σ_j (n_j·u_j)² s_j s_jᵀ),

    s_j the sum of w_i J_i over the partners i of j. A prior adds Λ to A and σ² Λ to B.

    References are `Points`.
    """

    sigma: ArrayLike
    """standard deviation of a range [m]"""
    _: dataclasses.KW_ONLY
    span: int = static(default=SPAN, check=at_least(1))
    """see `IcpSettings.span`"""
    gap: Number = field(default=GAP, check=positive)
    """see `IcpSettings.gap`"""

    def of_usable(self, matcher: Matcher, scans: MatchedScans) -> Float[Array, "3 3"]:
        reference, points, match, *_ = scans
        with refusals_of("AlongNormals"):
            reference = require("reference", reference, instance_of(Points))
        lines = surface(reference, self.span, self.gap)
        j = jnp.maximum(match.pair, 0)  # any partner for points without: their weight is 0
        weight = jnp.where(lines.straight[j], match.weight, 0.0)
        turn = se2.rotation(match.pose[2]).T
        arm, ray, n = points.position @ turn, points.ray @ turn, lines.normal[j]
        jacobian = jnp.concatenate(
            [n, (n[:, 1] * arm[:, 0] - n[:, 0] * arm[:, 1])[:, None]], axis=1
        )
        shape = information_of(jacobian, weight)
        # The columns w (n·R u) J of the scan's ranges, and (n_j·u_j) s_j of the reference's.
        by_scan = (weight * (n * ray).sum(axis=1))[:, None] * jacobian
        of_partner = jax.ops.segment_sum(weight[:, None] * jacobian, j, len(reference.valid))
        by_reference = (lines.normal * reference.ray).sum(axis=1)[:, None] * of_partner
        noise = by_scan.T @ by_scan + by_reference.T @ by_reference
        return noise_cov(match, add_prior(match, shape), noise, self.sigma)
