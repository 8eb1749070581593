"""The base class of covariances of a match, and what several of them share."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from jaxslam.core._record import check_field
from jaxslam.core.protocols import Component
from jaxslam.core.validation import positive
from jaxslam.laser.matching._matcher import Match, Matcher, MatchStatus, Reference
from jaxslam.laser.matching._point_sets import Points, move_along_rays, prior_terms
from jaxslam.math import _linalg as linalg


class MatchedScans(NamedTuple):
    """A match with its inputs."""

    reference: Reference
    """argument of `matcher.prepare`"""
    points: Points
    """of the scan"""
    match: Match
    start: Float[Array, "3"]
    """pose where the search began"""
    key: Array
    """for covariances that draw"""


class MatchCovariance(Component):
    """A covariance of the pose of a match, in its coordinates (x, y, θ); a subclass is a record."""

    sigma: Any
    """standard deviation of a range or residual [m]; a subclass without one does not know it"""

    def __post_init__(self) -> None:
        self._check(MatchCovariance, {"of_usable": "matcher, scans"})
        if hasattr(self, "sigma"):
            check_field(self, "sigma", positive)

    def of_usable(self, matcher: Matcher, scans: MatchedScans) -> Float[Array, "3 3"]:
        """The covariance of a match that did not fail, and finite if it did. Of a pair: vmap it."""
        raise NotImplementedError

    def of(self, matcher: Matcher, scans: MatchedScans) -> Float[Array, "3 3"]:
        """The covariance of a match; after a failure, that of the prior alone.

        That is σ² Λ⁻¹ with the σ of a residual, if the class has it; a direction without a prior is
        known to a kilometre or a thousand radians. A match failed if its status is UNLIKE or
        TOO_FEW.
        """
        match = scans.match
        zero = information = jnp.zeros_like(match.information)
        scale = jnp.ones((), information.dtype)
        if hasattr(self, "sigma"):
            scale = jnp.asarray(self.sigma, information.dtype)
            information = prior_terms(match.prior, match.pose)[0]
        prior_cov = scale**2 * inverse_of(information, zero, sigma=scale)
        usable = self.of_usable(matcher, scans)
        return jnp.where(match.status >= MatchStatus.UNLIKE, prior_cov, usable)


def covariance(
    way: MatchCovariance,
    matcher: Matcher,
    reference: Reference,
    points: Points,
    match: Match,
    start: ArrayLike,
    key: Array,
) -> Array:
    """The covariance (3, 3) of a match.

    With a leading axis on the start, and so on all arrays but the key, (B, 3, 3). For a match that
    is UNLIKE or TOO_FEW it is the covariance of the prior, and without a prior (1 km)² and
    (1000 rad)². Along `match.weakest` of a DEGENERATE match add the variance of the start.
    """
    begin = jnp.asarray(start)
    many = begin.ndim == 2
    keys = jax.random.split(key, len(begin)) if many else key
    scans = MatchedScans(reference, points, match, begin, keys)
    cov: Array = (_covariances if many else _covariance)(way, matcher, scans)
    return cov


@partial(jax.jit, inline=True)
def _covariance(way: MatchCovariance, matcher: Matcher, scans: MatchedScans) -> Array:
    return way.of(matcher, scans)


@partial(jax.jit, inline=True)
def _covariances(way: MatchCovariance, matcher: Matcher, scans: MatchedScans) -> Array:
    return jax.vmap(partial(way.of, matcher))(scans)


def inverse_of(
    curvature: Float[Array, "3 3"], otherwise: Float[Array, "3 3"], *, sigma: ArrayLike = 1.0
) -> Float[Array, "3 3"]:
    """The inverse of a curvature, or of `otherwise` if the curvature is not positive definite.

    The inverse is finite: (σ/1000)² is added to the diagonal, the curvature being σ² times an
    information, so that an undetermined direction is known to a kilometre or a thousand radians.
    """
    floor = (sigma * 1e-3) ** 2 * jnp.eye(3, dtype=curvature.dtype)
    # All three, and a choice between them: shapes are static, and each is finite.
    first, positive = linalg.whitener(linalg.symmetrize(curvature) + floor)
    second, usable = linalg.whitener(linalg.symmetrize(otherwise) + floor)
    last = jnp.eye(3, dtype=curvature.dtype) / (sigma * 1e-3)
    return linalg.self_gram(jnp.where(positive, first, jnp.where(usable, second, last)))


def noise_cov(
    match: Match, shape: Float[Array, "3 3"], noise: Float[Array, "3 3"], sigma: ArrayLike
) -> Float[Array, "3 3"]:
    """The covariance σ² A⁻¹ B A⁻¹ by the curvature A, prior included, and the scans' noise σ² B.

    The floor of `inverse_of` is added to B too: an undetermined direction has a kilometre.
    """
    sigma = jnp.asarray(sigma, noise.dtype)
    gain = inverse_of(shape, add_prior(match, match.information), sigma=sigma)
    floor = (sigma * 1e-3) ** 2 * jnp.eye(3, dtype=noise.dtype)
    return sigma**2 * gain @ (add_prior(match, noise) + floor) @ gain.T


def curvature(matcher: Matcher, prepared: PyTree, points: Points, match: Match) -> Array:
    """The curvature ∂²E/∂x² (3, 3) of the matcher's cost at the pose, pairs and weights kept."""
    # Without the prior, whose exact curvature Λ is added with the projection of the scans.
    alone = match._replace(prior=None)
    by_pose = jax.hessian(lambda pose: matcher.cost(prepared, points, pose, alone))
    return add_prior(match, jnp.asarray(by_pose(match.pose)))


def add_prior(match: Match, of_scans: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """The curvature, information or noise DᵀAD + Λ of scans (A) and prior (Λ); without prior A.

    D keeps what the scans determine (`Match.determined`), as the match does: along a corridor the
    noise of normals adds spurious information, which exceeds a realistic prior.
    """
    if match.prior is None:
        return of_scans
    onto = match.determined
    return onto.T @ of_scans @ onto + match.prior.information


def change_ranges(reference: Reference, by: Float[Array, "M"]) -> Reference:
    """The reference with changed ranges [m]; a grid is unchanged."""
    return move_along_rays(reference, by) if isinstance(reference, Points) else reference


def range_count(reference: Reference) -> int:
    """The number of ranges of a reference; 0 of a grid."""
    return len(reference.valid) if isinstance(reference, Points) else 0
