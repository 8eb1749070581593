"""The common end of all matchers: the score, what the scans determine, the status."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxslam.laser.matching._matcher import Match, MatchStatus
from jaxslam.laser.matching._point_sets import Points, Prior
from jaxslam.math import _linalg as linalg
from jaxslam.math._arrays import Number


class Limits(NamedTuple):
    """Thresholds below which a match is flagged."""

    fewest: int = 10
    """points with a partner"""
    score: Number = 0.5
    """of `Match.score`"""
    condition: Number | None = 0.01
    """of `Match.condition`; None: no match is DEGENERATE"""


class Pairs(NamedTuple):
    """The points of a scan and their partners in the reference."""

    residual: Float[Array, "N"]
    """[m]"""
    weight: Float[Array, "N"]
    """0 for points without a part"""
    partner: Int[Array, "N"] | int = 0
    """index of a reference point; 0 in a grid"""


class SearchEnd(NamedTuple):
    """The end of a search: its pose, and whether it converged."""

    pose: Float[Array, "3"]
    iterations: Int[Array, ""]
    converged: Bool[Array, ""] | bool
    ambiguous: Bool[Array, ""] | bool = False
    """another pose is nearly as good"""


def make_match(
    points: Points,
    start: Float[Array, "3"],
    prior: Prior | None,
    end: SearchEnd,
    pairs: Pairs,
    score: Float[Array, ""],
    information: Float[Array, "3 3"],
    limits: Limits,
) -> Match:
    """The `Match` of a scan whose search has ended, with its status.

    Of the statuses that apply the last of `MatchStatus` counts: along a degenerate direction other
    poses fit as well, so a match is called ambiguous only where it is not degenerate. With too few
    partners the pose is the start.
    """
    took_part = pairs.weight > 0
    # `tiny` and 1: without pairs or points the residual and the shares are 0, not NaN.
    total = jnp.maximum(pairs.weight.sum(), jnp.finfo(pairs.weight.dtype).tiny)
    count = jnp.maximum(points.valid.sum(), 1)
    length = length_of(points)
    condition, weakest = _weakest_direction(information, length)
    few = took_part.sum() < limits.fewest
    status = jnp.asarray(MatchStatus.CONVERGED, jnp.int32)
    for applies, value in (
        (~jnp.asarray(end.converged), MatchStatus.NOT_CONVERGED),
        (end.ambiguous, MatchStatus.AMBIGUOUS),
        (limits.condition is not None and condition < limits.condition, MatchStatus.DEGENERATE),
        (score < limits.score, MatchStatus.UNLIKE),
        (few, MatchStatus.TOO_FEW),
    ):
        status = jnp.where(applies, jnp.asarray(value, jnp.int32), status)
    inliers = took_part.sum(dtype=pairs.weight.dtype) / count.astype(pairs.weight.dtype)
    return Match(
        pose=jnp.where(few, start, end.pose),
        status=status,
        iterations=end.iterations,
        residual=jnp.sqrt((pairs.weight * pairs.residual**2).sum() / total),
        inliers=inliers,
        score=score,
        information=information,
        weakest=weakest,
        condition=condition,
        determined=project_to_determined(information, length, limits.condition),
        pair=jnp.where(took_part, jnp.asarray(pairs.partner, jnp.int32), -1),
        weight=pairs.weight,
        prior=prior,
    )


def mean_score(points: Points, pairs: Pairs, scale: Number) -> Float[Array, ""]:
    """The mean of exp(-½ (e/s)²) over the valid points of a scan, 0 for points without a part."""
    closeness = jnp.exp(-0.5 * (pairs.residual / scale) ** 2)
    closeness = jnp.where(pairs.weight > 0, closeness, 0.0)
    return closeness.sum() / jnp.maximum(points.valid.sum(dtype=closeness.dtype), 1)


def length_of(points: Points) -> Float[Array, ""]:
    """The root mean square distance of the points from the origin of their frame [m]; 1 of none.

    The factor of an angle beside lengths.
    """
    square = jnp.where(points.valid, (points.position**2).sum(axis=1), 0.0).sum()
    mean = square / jnp.maximum(points.valid.sum(dtype=square.dtype), 1)
    return jnp.sqrt(jnp.where(mean > 0, mean, 1.0))


def information_of(jacobian: Float[Array, "N 3"], weight: Float[Array, "N"]) -> Array:
    """The information Σ w J Jᵀ (3, 3) of weighted rows."""
    return linalg.gram(weight[:, None] * jacobian, jacobian)


def information_along(
    normal: Float[Array, "N 2"],
    tilt: Float[Array, "N"],
    arm: Float[Array, "N 2"],
    weight: Float[Array, "N"],
) -> Float[Array, "3 3"]:
    """The information Σ w J Jᵀ, J = (n, n·∂(R p)/∂θ), of lines; arms [m] from the pivot.

    A normal that is turned by noise of variance τ² has E n̂n̂ᵀ = (1 - τ²) nnᵀ + τ² ttᵀ, t along the
    line, which feigns information along a wall; hence the sum of (1 + τ²) n̂n̂ᵀ - τ² ttᵀ.
    """
    along = jnp.stack([normal[:, 1], -normal[:, 0]], axis=-1)

    def by_motion(v: Array) -> Array:
        turn = v[:, 1] * arm[:, 0] - v[:, 0] * arm[:, 1]
        return jnp.concatenate([v, turn[:, None]], axis=1)

    across = information_of(by_motion(normal), weight * (1 + tilt))
    return across - information_of(by_motion(along), weight * tilt)


def _weakest_direction(
    information: Float[Array, "3 3"], length: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, "3"]]:
    """The least over the largest eigenvalue, in [0, 1], and the eigenvector of the least.

    The angle is measured in lengths [m], so that the eigenvalues compare. Both are constants for
    derivatives.
    """
    scale = jnp.stack([jnp.ones_like(length), jnp.ones_like(length), 1 / length])
    a = jax.lax.stop_gradient(scale[:, None] * information * scale[None, :])
    least, largest = _extreme_eigenvalues(a)
    positive = largest > 0
    condition = jnp.clip(least / jnp.where(positive, largest, 1.0), 0.0, 1.0)
    return jnp.where(positive, condition, 0.0), eigenvector(a, least) * scale


def project_to_determined(
    information: Float[Array, "3 3"], length: Float[Array, ""], least: Number | None
) -> Float[Array, "3 3"]:
    """The projection D of a motion onto the determined directions; the identity if `least` is None.

    With lengths in RMS ranges, a direction is determined if it is an eigenvector whose eigenvalue
    is at least `least` of the largest (Zhang, Kaess & Singh 2016, "On degeneracy of
    optimization-based state estimation problems", ICRA). A constant for derivatives.

    | eigenvalues below `least` | D, with unit eigenvectors v₁ (least) and v₃ (largest) |
    |---|---|
    | none | I |
    | one | I - v₁ v₁ᵀ |
    | two | v₃ v₃ᵀ |
    | all, the matrix being zero | 0 |
    """
    eye = jnp.eye(3, dtype=information.dtype)
    if least is None:
        return eye
    scale = jnp.stack([jnp.ones_like(length), jnp.ones_like(length), 1 / length])
    a = jax.lax.stop_gradient(scale[:, None] * information * scale[None, :])
    low, high = _extreme_eigenvalues(a)
    positive = high > 0

    def is_below(value: Array) -> Array:
        return jnp.clip(value / jnp.where(positive, high, 1.0), 0.0, 1.0) < least

    weak, strong = eigenvector(a, low), eigenvector(a, high)
    across = eye - weak[:, None] * weak[None, :]
    along = jnp.where(positive, strong[:, None] * strong[None, :], 0.0)
    two = is_below(jnp.trace(a) - low - high) | ~positive  # the middle one is the rest of the trace
    projection = jnp.where(two, along, jnp.where(is_below(low), across, eye))
    return scale[:, None] * projection / scale[None, :]


def fuse_prior(
    curvature: Float[Array, "3 3"],
    slope: Float[Array, "3"],
    prior: tuple[Float[Array, "3 3"], Float[Array, "3"]],
    onto: Float[Array, "3 3"],
    length: Float[Array, ""],
) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
    """The curvature Dᵀ A D + Λ and the slope Dᵀ g + Λ e of a step with a prior.

    What the scans do not determine (D of `project_to_determined`) is the prior's alone, however
    little it says.

    Args:
        curvature, slope: A and g, of the scans.
        prior: Λ and Λ e (`prior_terms`).
        onto: D.
        length: [m] factor of an angle beside lengths.
    """
    scale = jnp.stack([jnp.ones_like(length), jnp.ones_like(length), length])
    eye = jnp.eye(3, dtype=curvature.dtype)
    free = scale[:, None] * (eye - onto)
    # A share ε^¾ of the trace of Λ, or of A if Λ is zero, keeps the matrix regular: a motion that
    # neither determines stays at zero. It is small beside all else, and large beside rounding.
    of_prior, of_scans = jnp.trace(prior[0]), jnp.trace(curvature)
    size = jnp.where(of_prior > 0, of_prior, jnp.where(of_scans > 0, of_scans, 1.0))
    keep = float(jnp.finfo(curvature.dtype).eps) ** 0.75 * size / length**2
    return onto.T @ curvature @ onto + prior[0] + keep * free.T @ free, onto.T @ slope + prior[1]


def _extreme_eigenvalues(a: Float[Array, "3 3"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The least and the largest eigenvalue of a symmetric matrix.

    By the roots of its characteristic polynomial as cosines: with q = tr A/3, p² = |A - q I|²/6
    and B = (A - q I)/p, they are q + 2 p cos(φ + 2πk/3), 3φ = acos(det B/2) (Smith 1961,
    "Eigenvalues of a symmetric 3 × 3 matrix", Communications of the ACM 4). Errors are rounding of
    the largest.
    """
    q = jnp.trace(a) / 3
    b = a - q * jnp.eye(3, dtype=a.dtype)
    p = jnp.sqrt((b * b).sum() / 6)
    b = b / jnp.where(p > 0, p, 1.0)
    half = 0.5 * (b[0] * jnp.cross(b[1], b[2])).sum()  # det B/2, by rounding beyond [-1, 1]
    phi = jnp.arccos(jnp.clip(half, -1.0, 1.0)) / 3
    return q + 2 * p * jnp.cos(phi + 2 * np.pi / 3), q + 2 * p * jnp.cos(phi)


def eigenvector(a: Float[Array, "3 3"], value: Float[Array, ""]) -> Float[Array, "3"]:
    """A unit eigenvector of a symmetric matrix: the largest cross product of two rows of A - λI.

    If λ is a double eigenvalue, any vector across a row; of a multiple of I, (1, 0, 0).
    """
    rows = a - value * jnp.eye(3, dtype=a.dtype)
    across = jnp.stack([jnp.cross(rows[i], rows[j]) for i, j in ((0, 1), (1, 2), (2, 0))])
    size = (across**2).sum(axis=1)
    row = rows[jnp.argmax((rows**2).sum(axis=1))]
    # Rows are parallel to some hundred ulp where λ is double: its rounding is that of the largest.
    tiny = 100 * jnp.finfo(a.dtype).eps
    norm = (row**2).sum()
    # Across a row: its product with the axis of its least entry, which is farthest from parallel.
    axis = jnp.eye(3, dtype=a.dtype)[jnp.argmin(jnp.abs(row))]
    across_row = jnp.where(norm > 0, jnp.cross(row, axis), jnp.eye(3, dtype=a.dtype)[0])
    is_double = size.max() <= (tiny * norm) ** 2
    vector = jnp.where(is_double, across_row, across[jnp.argmax(size)])
    return vector / jnp.sqrt((vector**2).sum())
