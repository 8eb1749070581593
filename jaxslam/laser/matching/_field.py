"""Levenberg's method on the distance field of a grid."""

import dataclasses
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.core._record import field, record, static
from jaxslam.core.validation import at_least, or_none, positive
from jaxslam.graphs._solver.kernels import Kernel
from jaxslam.laser.grids._distance import distance_field
from jaxslam.laser.grids._grid import Field, Grid, interpolate, to_cells
from jaxslam.laser.matching._matcher import Match, Matcher
from jaxslam.laser.matching._outcome import (
    Limits,
    Pairs,
    SearchEnd,
    fuse_prior,
    information_of,
    length_of,
    make_match,
    mean_score,
    project_to_determined,
)
from jaxslam.laser.matching._point_sets import Points, Prior, prior_cost, prior_terms
from jaxslam.laser.matching._surfaces import surface, surface_information, weights
from jaxslam.math import _linalg as linalg
from jaxslam.math import se2
from jaxslam.math._arrays import Number, in_dtype
from jaxslam.math.angles import wrap

_DAMPING = (1e-3, 1e-9, 1e9)
"""Damping μ at first, at least and at most, relative to the diagonal of the information."""
_LEAST_DIAGONAL = 1e-9
"""Least entry of the damped diagonal, relative to the largest entry and absolute, so that a
direction without information is damped too."""


class _Linearization(NamedTuple):
    """The cost and its derivatives at a pose."""

    cost: Float[Array, ""]
    residual: Float[Array, "N"]
    weight: Float[Array, "N"]
    curvature: Float[Array, "3 3"]
    """A, of the scan"""
    slope: Float[Array, "3"]
    """half of the slope of the scan's cost"""


_State: TypeAlias = tuple[Array, Array, _Linearization, Array, Array]
"""Iterations, pose, linearization there, damping, whether the last step was small."""


@record
class FieldMatcher(Matcher):
    """The pose that minimizes Σ ρ(d(T ∘ p_i)²), d the distance to the nearest occupied cell.

    d [m] is truncated at reach, and interpolated between centres of cells, so that the cost is
    continuous and no pairs are chosen; a point of d >= reach has a constant cost, and no part.
    Levenberg's method: (A + μ diag A) δ = -Σ w d J, A = Σ w J Jᵀ, J = (∇d, ∇d·∂(R p)/∂θ);
    a step that does not reduce the cost is refused and μ grows tenfold; else μ falls tenfold.
    The reference is a `Grid`; `raster` makes one of points.

    The slope of a field of cells feigns information along a wall, so the status and
    `Match.information` are by the lines of the scan (`surface_information`), and a step has no part
    along what these do not determine.

    Fitzgibbon 2003, "Robust registration of 2D and 3D point sets", Image and Vision Computing 21.

    Raises ValueError on a number out of range.
    """

    _: dataclasses.KW_ONLY
    reach: Number = field(default=0.5, check=positive)
    """largest distance that counts [m]"""
    kernel: Kernel | None = None
    """ρ, as `graphs.Huber()`, of (d/scale)²; None for squares"""
    scale: Number = field(default=0.1, check=positive)
    """[m] of the kernel and of `Match.score`"""
    iterations: int = static(default=50, check=at_least(1))
    """at most"""
    tolerance: Number = field(default=1e-6, check=positive)
    """of convergence: the motion of a step [m], angles times the RMS range"""
    least_score: Number = 0.5
    """`Match.score` below which the status is UNLIKE"""
    least_condition: Number | None = field(default=0.01, check=or_none(positive))
    """`Match.condition` below which the status is DEGENERATE; None: never"""
    name = "field"
    of_grid = True

    def prepare(self, reference: Grid) -> Field:
        return distance_field(reference, truncate=in_dtype(self, reference.log_odds.dtype).reach)

    def match(
        self,
        prepared: Field,
        points: Points,
        start: Float[Array, "3"],
        prior: Prior | None = None,
    ) -> Match:
        matcher = in_dtype(self, start.dtype)
        length, lines = length_of(points), surface(points)
        low, high = _DAMPING[1:]

        def goes_on(state: _State) -> Array:
            return jnp.asarray((state[0] < self.iterations) & ~state[4])

        def onto_of(pose: Array, at: _Linearization) -> Array:
            information = surface_information(lines, pose, at.weight)
            return project_to_determined(information, length, matcher.least_condition)

        def move_pose(pose: Array, move: Array) -> Array:
            return jnp.concatenate([pose[:2] + move[:2], wrap(pose[2] + move[2])[None]])

        def step(state: _State) -> _State:
            k, pose, at, damping, _ = state
            diagonal = jnp.diagonal(at.curvature)
            diagonal = jnp.maximum(
                diagonal, _LEAST_DIAGONAL * jnp.maximum(diagonal.max(), _LEAST_DIAGONAL)
            )
            damped = at.curvature + damping * jnp.diag(diagonal)
            onto = onto_of(pose, at)
            curvature, slope = fuse_prior(damped, at.slope, prior_terms(prior, pose), onto, length)
            move, _ = linalg.solve_psd(curvature, -slope)
            tried = move_pose(pose, move)
            trial = matcher._linearize(prepared, points, tried, prior)
            # A refused step counts as small as well: then μ is so large that no step helps.
            better = trial.cost < at.cost
            small = jnp.hypot(move[0], move[1]) + length * jnp.abs(move[2]) <= matcher.tolerance
            pose = jnp.where(better, tried, pose)
            at = jax.tree.map(lambda new, old: jnp.where(better, new, old), trial, at)
            damping = jnp.clip(jnp.where(better, 0.1 * damping, 10 * damping), low, high)
            return k + 1, pose, at, damping, small

        begin = start
        if prior is not None:
            # Along directions that the scan does not determine it begins at the prior: a step that
            # the roughness of a field of cells might refuse.
            onto = onto_of(start, matcher._linearize(prepared, points, start, prior))
            free = jnp.eye(3, dtype=start.dtype) - onto
            information, slope = prior_terms(prior, start)
            # Determined directions are held at the start by a curvature of 1 and no slope.
            held = jnp.diag(jnp.stack([jnp.ones_like(length), jnp.ones_like(length), length**2]))
            terms = free.T @ information @ free, free.T @ slope
            curvature, slope = fuse_prior(held, 0 * slope, terms, onto, length)
            begin = move_pose(start, linalg.solve_psd(curvature, -slope)[0])
        first = (
            jnp.zeros((), jnp.int32),
            begin,
            matcher._linearize(prepared, points, begin, prior),
            jnp.asarray(_DAMPING[0], start.dtype),
            jnp.zeros((), bool),
        )
        k, pose, at, _, small = jax.lax.while_loop(goes_on, step, first)
        pairs = Pairs(at.residual, at.weight)
        return make_match(
            points,
            start,
            prior,
            SearchEnd(pose, k, small),
            pairs,
            mean_score(points, pairs, matcher.scale),
            surface_information(lines, pose, at.weight),
            Limits(score=matcher.least_score, condition=matcher.least_condition),
        )

    def cost(
        self, prepared: Field, points: Points, pose: Float[Array, "3"], match: Match
    ) -> Float[Array, ""]:
        return field_cost(prepared, points, pose, match.weight) + prior_cost(match.prior, pose)

    def _linearize(
        self, of: Field, points: Points, pose: Array, prior: Prior | None
    ) -> _Linearization:
        residual, jacobian = field_residuals(of, points, pose)
        # Beyond the grid the field has the values of its border.
        moved = points.position @ se2.rotation(pose[2]).T + pose[None, :2]
        cell = to_cells(of.origin, of.resolution, moved)
        size = jnp.asarray(of.values.shape[::-1], cell.dtype)
        on_map = jnp.all((cell >= 0) & (cell <= size[None]), axis=1)
        used = points.valid & on_map & (residual < self.reach)
        weight = weights(residual, used, self.kernel, self.scale)
        curvature, slope = information_of(jacobian, weight), (weight * residual) @ jacobian
        cost = self._robust_cost(residual, points) + 2 * prior_cost(prior, pose)
        return _Linearization(cost, residual, weight, curvature, slope)

    def _robust_cost(self, residual: Array, points: Points) -> Float[Array, ""]:
        """The sum of ρ over the valid points, also beyond reach, so that leaving has no gain."""
        square = residual**2
        if self.kernel is not None:
            square = self.scale**2 * self.kernel.cost(square / self.scale**2)
        return jnp.where(points.valid, square, 0.0).sum()


def field_residuals(
    of: Field, points: Points, pose: Float[Array, "3"]
) -> tuple[Float[Array, "N"], Float[Array, "N 3"]]:
    """The field [m] at the points of a scan at a pose, and its derivative by the pose.

    J = (∇d, ∇d · (-(R p)_y, (R p)_x)).
    """
    arm = points.position @ se2.rotation(pose[2]).T
    moved = arm + pose[None, :2]
    d, pull = jax.vjp(lambda p: interpolate(of, p), moved)
    # d of a point depends on that point alone, so one pull of ones gives the slopes of all.
    (slope,) = pull(jnp.ones_like(d))
    turn = slope[:, 1] * arm[:, 0] - slope[:, 0] * arm[:, 1]
    return d, jnp.concatenate([slope, turn[:, None]], axis=1)


def field_cost(
    of: Field, points: Points, pose: Float[Array, "3"], weight: Float[Array, "N"]
) -> Float[Array, ""]:
    """The cost ½ Σ w d² of a pose, d the distances of its points from the nearest occupied cell."""
    moved = points.position @ se2.rotation(pose[2]).T + pose[None, :2]
    d = interpolate(of, moved)
    return 0.5 * (weight * jnp.where(weight > 0, d, 0.0) ** 2).sum()
