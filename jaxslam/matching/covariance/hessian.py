"""The covariance that a quadratic cost would have: its inverse second derivative."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.core.record import record
from jaxslam.matching.covariance.record import (
    MatchCovariance,
    MatchedScans,
    beside_prior,
    curvature,
    inverse_of,
)
from jaxslam.matching.matcher import Matcher


@record
class Hessian(MatchCovariance):
    """The covariance s² (∂²E/∂x²)⁻¹, E = ½ Σ w e², s² = 2E/(n - 3) of n pairs; 2E/n with a prior.

    Right for independent residuals of one variance that the pairs do not follow. Two scans of
    different density, and pairs that change with the pose, break that.
    Bengtsson & Baerveldt 2003, "Robot localization based on scan-matching: estimating the
    covariance matrix for the IDC algorithm", Robotics and Autonomous Systems 44.
    """

    def of_usable(self, matcher: Matcher, scans: MatchedScans) -> Float[Array, "3 3"]:
        reference, points, found, *_ = scans
        prepared = matcher.prepare(reference)
        free = (found.weight > 0).sum() - (3 if found.prior is None else 0)
        least = 2 * matcher.cost(prepared, points, found.pose, found) / jnp.maximum(free, 1)
        shape = curvature(matcher, prepared, points, found)
        return least * inverse_of(shape, beside_prior(found, found.information))
