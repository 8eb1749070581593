"""The base class of covariances of a match, and what several of them share."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from jaxslam.core._numbers import check_positive
from jaxslam.core.protocols import Component
from jaxslam.laser.matching._matcher import Match, Matcher, MatchStatus, Reference
from jaxslam.laser.matching._point_sets import Points, moved_along_rays, prior_terms
from jaxslam.math import _linalg as linalg


class MatchedScans(NamedTuple):
    """A match with its inputs."""

    reference: Reference
    """the argument of `matcher.prepare`"""
    points: Points
    found: Match
    start: Float[Array, "3"]
    key: Array
    """for covariances that draw"""


class MatchCovariance(Component):
    """A covariance of the pose of a match, in its coordinates (x, y, θ); a subclass is a record."""

    sigma: Any
    """standard deviation of a range or residual [m]; a subclass without one does not know it"""

    def __post_init__(self) -> None:
        self._check(MatchCovariance, {"of_usable": "matcher, scans"})
        if hasattr(self, "sigma"):
            check_positive(type(self).__name__, sigma=self.sigma)

    def of_usable(self, matcher: Matcher, scans: MatchedScans) -> Float[Array, "3 3"]:
        """The covariance of a match that did not fail; finite of any. Of one pair: vmap it."""
        raise NotImplementedError

    def of(self, matcher: Matcher, scans: MatchedScans) -> Float[Array, "3 3"]:
        """The covariance of a match; after a failure, that of the prior alone.

        That is σ² Λ⁻¹ with the σ of a residual, if that is known; what no prior tells, or all
        without one, is known to a kilometre or a thousand radians. A match failed if its status is
        UNLIKE or TOO_FEW.
        """
        found = scans.found
        nothing = known = jnp.zeros_like(found.information)
        scale = jnp.ones((), known.dtype)
        if hasattr(self, "sigma"):
            scale = jnp.asarray(self.sigma, known.dtype)
            known = prior_terms(found.prior, found.pose)[0]
        unknown = scale**2 * inverse_of(known, nothing, sigma=scale)
        usable = self.of_usable(matcher, scans)
        return jnp.where(found.status >= MatchStatus.UNLIKE, unknown, usable)


def covariance(
    way: MatchCovariance,
    matcher: Matcher,
    reference: Reference,
    points: Points,
    found: Match,
    start: ArrayLike,
    key: Array,
) -> Array:
    """The covariance (3, 3) of a match.

    With a leading axis on the start, and so on all arrays but the key, (B, 3, 3). Of a match
    that is UNLIKE or TOO_FEW it is that of the prior, and otherwise (1 km)² and (1000 rad)². Along
    `found.weakest` of a DEGENERATE match add the variance of the start.
    """
    begin = jnp.asarray(start)
    many = begin.ndim == 2
    keys = jax.random.split(key, len(begin)) if many else key
    scans = MatchedScans(reference, points, found, begin, keys)
    cov: Array = (_many if many else _one)(way, matcher, scans)
    return cov


@partial(jax.jit, inline=True)
def _one(way: MatchCovariance, matcher: Matcher, scans: MatchedScans) -> Array:
    return way.of(matcher, scans)


@partial(jax.jit, inline=True)
def _many(way: MatchCovariance, matcher: Matcher, scans: MatchedScans) -> Array:
    return jax.vmap(partial(way.of, matcher))(scans)


def inverse_of(
    curvature: Float[Array, "3 3"], otherwise: Float[Array, "3 3"], *, sigma: ArrayLike = 1.0
) -> Float[Array, "3 3"]:
    """The inverse of a cost's second derivative; where that is not positive definite, of another.

    What neither determines is known to a kilometre or a thousand radians, so that it is finite:
    (σ/1000)² is added to the diagonal, the curvature being σ² times an information.
    """
    floor = (sigma * 1e-3) ** 2 * jnp.eye(3, dtype=curvature.dtype)
    first, positive = linalg.whitener(linalg.symmetrize(curvature) + floor)
    second, usable = linalg.whitener(linalg.symmetrize(otherwise) + floor)
    last = jnp.eye(3, dtype=curvature.dtype) / (sigma * 1e-3)
    return linalg.self_gram(jnp.where(positive, first, jnp.where(usable, second, last)))


def propagated(
    found: Match, shape: Float[Array, "3 3"], noise: Float[Array, "3 3"], sigma: ArrayLike
) -> Float[Array, "3 3"]:
    """The covariance σ² A⁻¹ B A⁻¹ of a curvature A, with a prior's, and the scans' noise σ² B.

    What neither scans nor prior determine has the noise of `inverse_of`'s floor: a kilometre.
    """
    sigma = jnp.asarray(sigma, noise.dtype)
    gain = inverse_of(shape, beside_prior(found, found.information), sigma=sigma)
    floor = (sigma * 1e-3) ** 2 * jnp.eye(3, dtype=noise.dtype)
    return sigma**2 * gain @ (beside_prior(found, noise) + floor) @ gain.T


def curvature(matcher: Matcher, prepared: PyTree, points: Points, found: Match) -> Array:
    """The curvature ∂²E/∂x² (3, 3) of the matcher's cost at the pose, pairs and weights kept."""
    alone = found._replace(prior=None)
    by_pose = jax.hessian(lambda pose: matcher.cost(prepared, points, pose, alone))
    return beside_prior(found, jnp.asarray(by_pose(found.pose)))


def beside_prior(found: Match, of_scans: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Curvature, information or noise DᵀAD + Λ, of which the scans have A and a prior Λ; A alone
    without a prior.

    D leaves what the scans determine (`Match.determined`), as the match does: along a corridor the
    noise of normals adds spurious information, which exceeds a realistic prior.
    """
    if found.prior is None:
        return of_scans
    onto = found.determined
    return onto.T @ of_scans @ onto + found.prior.information


def with_ranges(reference: Reference, by: Float[Array, "M"]) -> Reference:
    """The reference with its ranges changed [m], if it is of points; a grid is unchanged."""
    return moved_along_rays(reference, by) if isinstance(reference, Points) else reference


def range_count(reference: Reference) -> int:
    """How many ranges a reference is made of; 0 of a grid."""
    return len(reference.valid) if isinstance(reference, Points) else 0
