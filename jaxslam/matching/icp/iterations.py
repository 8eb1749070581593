"""The loop that the iterative closest point methods share: pairs, a closed-form step, again."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.graphs.solver.kernels import Kernel
from jaxslam.matching.correspondences import Rule, nearest_points, weights
from jaxslam.matching.icp.closed_form import Quadratic, added, least, linearized, of_prior
from jaxslam.matching.matcher import Match, Matcher
from jaxslam.matching.outcome import (
    Limits,
    concluded,
    determined,
    fused,
    information_along,
    length_of,
)
from jaxslam.matching.points import Points
from jaxslam.matching.prior import Prior, prior_cost, prior_terms
from jaxslam.matching.surface import Surface, surface
from jaxslam.math import linalg, se2
from jaxslam.math.angles import wrap


@dataclass(frozen=True)
class IcpSettings:
    """The numbers of `point_to_point` and `point_to_line`; ValueError if out of range."""

    reach: float = 0.5
    """largest distance of partners [m]"""
    trim: float = 1.0
    """share of the pairs that is kept at each step, those of the smallest residuals"""
    kernel: Kernel | None = None
    """robust, as `graphs.Huber()`, of (residual/scale)²; None for squares"""
    scale: float = 0.1
    """[m] of the kernel and of `Match.score`"""
    span: int = 5
    """neighbours on each side that a line is fitted to"""
    gap: float = 0.5
    """[m] between points beyond which they are not neighbours"""
    lone: float = 0.0
    """of `point_to_line`: the factor of the distance from a point that has no line, as in clutter;
    0 leaves such points out"""
    iterations: int = 200
    """at most"""
    tolerance: float = 1e-6
    """of convergence: the motion of a step [m], angles times the RMS range"""
    fewest: int = 10
    """pairs below which the status is TOO_FEW"""
    least_score: float = 0.5
    """`Match.score` below which it is UNLIKE"""
    least_condition: float = 0.01
    """`Match.condition` below which it is DEGENERATE"""

    def __post_init__(self) -> None:
        lengths = (self.reach, self.scale, self.gap, self.tolerance)
        if not (all(length > 0 for length in lengths) and 0 < self.trim <= 1):
            raise ValueError(
                "IcpSettings: expected reach, scale, gap and tolerance above 0 and trim in (0, 1], "
                f"got {self.reach}, {self.scale}, {self.gap}, {self.tolerance}, {self.trim}"
            )
        if self.span < 1 or self.iterations < 1 or not (self.lone >= 0 and self.fewest >= 0):
            raise ValueError(
                "IcpSettings: expected span and iterations >= 1, lone and fewest >= 0, got "
                f"{self.span}, {self.iterations}, {self.lone}, {self.fewest}"
            )


DEFAULT = IcpSettings()


class PairedPoints(NamedTuple):
    """A scan at a pose, and its partners."""

    moved: Float[Array, "N 2"]
    """the points of the scan in the frame of the reference"""
    partner: Int[Array, "N"]
    residual: Float[Array, "N"]
    """not below 0 for point-to-point [m]"""
    weight: Float[Array, "N"]


class Metric(NamedTuple):
    """The cost that an ICP minimizes: its residuals, its pairs and its quadratic form."""

    residual: Callable[[Surface, Array, Array], Array]
    """(surface, moved points, partners) -> (N,) [m]"""
    usable: Callable[[Surface], Bool[Array, "M"]]
    """which points of the reference may be partners"""
    quadratic: Callable[[Surface, PairedPoints, Array], Quadratic]
    """(surface, pairs, middle (2,)) -> Σ w e² of a motion about the middle"""
    cost: Callable[[Surface, Array, Array, Array], Array]
    """(surface, moved points, partners, weights) -> ½ Σ w e²"""


_State: TypeAlias = tuple[Array, Array, Array, Array]
"""iterations, pose, the pose before, how far the last step went"""


def icp(name: str, metric: Metric, settings: IcpSettings) -> Matcher:
    """The matcher of a metric."""
    reach, iterations, tolerance = settings.reach, settings.iterations, settings.tolerance
    rule = Rule(reach, settings.trim, settings.kernel, settings.scale)
    limits = Limits(settings.fewest, settings.least_score, settings.least_condition)

    def pairs_at(of: Surface, points: Points, pose: Array) -> PairedPoints:
        moved = points.position @ se2.rotation(pose[2]).T + pose[None, :2]
        partner = nearest_points(of.position, moved)
        distance = ((moved - of.position[partner]) ** 2).sum(axis=1)
        possible = points.valid & (distance < reach**2) & metric.usable(of)[partner]
        residual = jnp.where(possible, metric.residual(of, moved, partner), 0.0)
        return PairedPoints(moved, partner, residual, weights(rule, residual, possible))

    def match(of: Surface, points: Points, start: Array, prior: Prior | None = None) -> Match:
        length = length_of(points)

        def within(of: Quadratic, middle: Array, onto: Array, pose: Array) -> Array:
            arm = middle - pose[:2]
            to_middle = jnp.eye(3, dtype=pose.dtype).at[:2, 2].set(jnp.stack([-arm[1], arm[0]]))
            curvature, slope = linearized(of)
            curvature, slope = to_middle.T @ curvature @ to_middle, to_middle.T @ slope
            curvature, slope = fused(curvature, slope, prior_terms(prior, pose), onto, length)
            return to_middle @ linalg.solve_psd(curvature, -slope)[0]

        def unfinished(state: _State) -> Array:
            k, _, _, change = state
            return jnp.asarray((k < iterations) & (change > tolerance))

        def step(state: _State) -> _State:
            k, pose, before, _ = state
            pairs = pairs_at(of, points, pose)
            total = pairs.weight.sum()
            middle = pairs.weight @ pairs.moved / jnp.where(total > 0, total, 1.0)
            quadratic = metric.quadratic(of, pairs, middle)
            both = quadratic
            if prior is not None:
                both = added(quadratic, of_prior(prior, pose, middle))
            information = _information(of, pairs, pose[:2], settings.lone)
            onto = determined(information, length, limits.condition)
            # The exact step where the scans determine all of it, else that of Gauss and Newton.
            moved = jnp.where(
                (onto == jnp.eye(3)).all(),
                least(both),
                within(quadratic, middle, onto, pose),
            )
            pivot = se2.from_frame(moved, pose[:2] - middle) + middle
            after = jnp.concatenate([pivot, wrap(pose[2] + moved[2])[None]])
            # A limit cycle of two steps, where pairs alternate, has ended as well.
            change = jnp.minimum(_size(after, pose, length), _size(after, before, length))
            return k + 1, after, pose, change

        far = jnp.full(3, jnp.inf, start.dtype).at[2].set(0.0)
        first = jnp.zeros((), jnp.int32), start, far, jnp.asarray(jnp.inf, start.dtype)
        k, pose, _, change = jax.lax.while_loop(unfinished, step, first)
        at = pairs_at(of, points, pose)
        return concluded(
            start,
            pose,
            points,
            residual=at.residual,
            weight=at.weight,
            pair=at.partner,
            information=_information(of, at, pose[:2], settings.lone),
            spread=settings.scale,
            iterations=k,
            converged=change <= tolerance,
            limits=limits,
            prior=prior,
        )

    def cost(of: Surface, points: Points, pose: Array, found: Match) -> Array:
        moved = points.position @ se2.rotation(pose[2]).T + pose[None, :2]
        of_pairs = metric.cost(of, moved, jnp.maximum(found.pair, 0), found.weight)
        return of_pairs + prior_cost(found.prior, pose)

    def prepare(reference: Points) -> Surface:
        return surface(reference, settings.span, settings.gap)

    return Matcher(name, prepare, match, cost)


def _size(a: Array, b: Array, length: Array) -> Array:
    """How far two poses are apart [m]."""
    return jnp.hypot(a[0] - b[0], a[1] - b[1]) + length * jnp.abs(wrap(a[2] - b[2]))


def _information(
    of: Surface, at: PairedPoints, pivot: Float[Array, "2"], lone: float
) -> Float[Array, "3 3"]:
    """The information Σ w J Jᵀ about the pivot, of partners with a line and of those without."""
    j, arm = at.partner, at.moved - pivot[None]
    straight = of.straight[j]
    by_lines = information_along(of.normal[j], of.tilt[j], arm, jnp.where(straight, at.weight, 0.0))
    if lone == 0:
        return by_lines
    weight = lone**2 * jnp.where(straight, 0.0, at.weight)
    axis = jnp.zeros_like(arm).at[:, 0].set(1.0)
    none = jnp.zeros_like(weight)
    return (
        by_lines
        + information_along(axis, none, arm, weight)
        + information_along(axis[:, ::-1], none, arm, weight)
    )
