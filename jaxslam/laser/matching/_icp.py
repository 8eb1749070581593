"""Iterative closest point: pairs of nearest points and an exact step, again and again.

With distances between points, or from points to lines (PL-ICP).
"""

from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.core._numbers import is_concrete
from jaxslam.core._record import check_field, field, record, static
from jaxslam.core.validation import at_least, instance_of, or_none, positive
from jaxslam.graphs._solver.kernels import Kernel
from jaxslam.laser.matching._closed_form import (
    Quadratic,
    add,
    minimizer,
    normal_equations,
    of_lines,
    of_points,
    of_prior,
)
from jaxslam.laser.matching._matcher import Match, Matcher
from jaxslam.laser.matching._outcome import (
    Limits,
    Pairs,
    SearchEnd,
    fuse_prior,
    information_along,
    length_of,
    make_match,
    mean_score,
    project_to_determined,
)
from jaxslam.laser.matching._point_sets import Points, Prior, prior_cost, prior_terms
from jaxslam.laser.matching._surfaces import GAP, SPAN, Surface, nearest_points, surface, weights
from jaxslam.math import _linalg as linalg
from jaxslam.math import se2
from jaxslam.math._arrays import Number, in_dtype
from jaxslam.math.angles import wrap


def _share(value: Any) -> Any:
    """The check of a share, above 0 and at most 1."""
    if is_concrete(value) and not 0 < positive(value) <= 1:
        raise ValueError(f"expected a number in (0, 1], got {value}")
    return value


@record
class IcpSettings:
    """The numbers of `PointToPoint` and `PointToLine`; ValueError if out of range."""

    reach: Number = field(default=0.5, check=positive)
    """largest distance of partners [m]"""
    trim: Number | None = field(default=None, check=or_none(_share))
    """share of the pairs kept at each step, those of the smallest residuals; None for all"""
    kernel: Kernel | None = None
    """robust, as `graphs.Huber()`, of (residual/scale)²; None for squares"""
    scale: Number = field(default=0.1, check=positive)
    """[m] of the kernel and of `Match.score`"""
    span: int = static(default=SPAN, check=at_least(1))
    """neighbours on each side that a line is fitted to"""
    gap: Number = field(default=GAP, check=positive)
    """[m] between points beyond which they are not neighbours"""
    lone: Number | None = field(default=None, check=or_none(positive))
    """of `PointToLine`: the factor of the distance from a point that has no line, as in clutter;
    None leaves such points out"""
    iterations: int = static(default=200, check=at_least(1))
    """at most"""
    tolerance: Number = field(default=1e-6, check=positive)
    """of convergence: the motion of a step [m], angles times the RMS range; at least 8 eps of the
    coordinates, 3e-5 at 30 m in float32"""
    fewest: int = static(default=10, check=at_least(0))
    """pairs below which the status is TOO_FEW"""
    least_score: Number = 0.5
    """`Match.score` below which the status is UNLIKE"""
    least_condition: Number | None = field(default=0.01, check=or_none(positive))
    """`Match.condition` below which the status is DEGENERATE; None: never"""


class _PairedPoints(NamedTuple):
    """The points of a scan at a pose, with their partners."""

    moved: Float[Array, "N 2"]
    """the points of the scan in the frame of the reference"""
    partner: Int[Array, "N"]
    """index of the nearest point of the reference"""
    residual: Float[Array, "N"]
    """[m], not below 0 for point-to-point"""
    weight: Float[Array, "N"]
    """0 for rejected pairs"""


_State: TypeAlias = tuple[Array, Array, Array, Array]
"""Iterations, pose, the pose before, change of the last step [m]."""


class Icp(Matcher):
    """An iterative closest point method: a subclass has the cost of pairs and its minimum."""

    settings: IcpSettings

    def __post_init__(self) -> None:
        super().__post_init__()
        check_field(self, "settings", instance_of(IcpSettings))

    def residual(self, of: Surface, moved: Array, partner: Array) -> Float[Array, "N"]:
        """The residual [m] between each point of a scan and its partner."""
        raise NotImplementedError

    def usable_points(self, of: Surface) -> Bool[Array, "M"]:
        """The mask of the points of the reference that may be partners."""
        return jnp.ones_like(of.straight)

    def quadratic(self, of: Surface, pairs: _PairedPoints, middle: Array) -> Quadratic:
        """The cost Σ w e² of a motion (t, r) about a middle (2,), for fixed pairs."""
        raise NotImplementedError

    def cost_of_pairs(
        self, of: Surface, moved: Array, partner: Array, weight: Array
    ) -> Float[Array, ""]:
        """The cost ½ Σ w e²."""
        raise NotImplementedError

    def prepare(self, reference: Points) -> Surface:
        return surface(reference, self.settings.span, self.settings.gap)

    def match(
        self,
        prepared: Surface,
        points: Points,
        start: Float[Array, "3"],
        prior: Prior | None = None,
    ) -> Match:
        icp = in_dtype(self, start.dtype)
        settings, length = icp.settings, length_of(points)
        limits = Limits(settings.fewest, settings.least_score, settings.least_condition)

        def step_within(of: Quadratic, middle: Array, onto: Array, pose: Array) -> Array:
            """The step of Gauss and Newton without what the scans do not determine."""
            # `onto` and the prior are of motions about the pose, the quadratic of motions about
            # the middle.
            arm = middle - pose[:2]
            to_middle = jnp.eye(3, dtype=pose.dtype).at[:2, 2].set(jnp.stack([-arm[1], arm[0]]))
            curvature, slope = normal_equations(of)
            curvature, slope = to_middle.T @ curvature @ to_middle, to_middle.T @ slope
            terms = prior_terms(prior, pose)
            curvature, slope = fuse_prior(curvature, slope, terms, onto, length)
            return to_middle @ linalg.solve_psd(curvature, -slope)[0]

        # The rounding of a step is some ulp of the coordinates: 1e-5 m in float32 at 10 m.
        far = length + jnp.abs(start[:2]).max()
        tolerance = jnp.maximum(settings.tolerance, 8 * float(jnp.finfo(start.dtype).eps) * far)

        def goes_on(state: _State) -> Array:
            k, _, _, change = state
            return jnp.asarray((k < settings.iterations) & (change > tolerance))

        def step(state: _State) -> _State:
            k, pose, before, _ = state
            pairs = icp._pairs(prepared, points, pose)
            total = pairs.weight.sum()
            middle = pairs.weight @ pairs.moved / jnp.where(total > 0, total, 1.0)
            quadratic = icp.quadratic(prepared, pairs, middle)
            with_prior = quadratic
            if prior is not None:
                with_prior = add(quadratic, of_prior(prior, pose, middle))
            information = _information(prepared, pairs, pose[:2], settings.lone)
            onto = project_to_determined(information, length, limits.condition)
            # The exact step where the scans determine all of it, else that of Gauss and Newton.
            moved = jnp.where(
                (onto == jnp.eye(3, dtype=onto.dtype)).all(),
                minimizer(with_prior),
                step_within(quadratic, middle, onto, pose),
            )
            # The motion turns about the middle: p ← R (p - m) + m + t.
            pivot = se2.from_frame(moved, pose[:2] - middle) + middle
            after = jnp.concatenate([pivot, wrap(pose[2] + moved[2])[None]])
            # A limit cycle of two steps, where pairs alternate, has ended as well.
            change = jnp.minimum(
                _pose_distance(after, pose, length), _pose_distance(after, before, length)
            )
            return k + 1, after, pose, change

        # No pose before the first: infinitely far away, with an angle that can be wrapped.
        before = jnp.full(3, jnp.inf, start.dtype).at[2].set(0.0)
        first = jnp.zeros((), jnp.int32), start, before, jnp.asarray(jnp.inf, start.dtype)
        k, pose, _, change = jax.lax.while_loop(goes_on, step, first)
        at = icp._pairs(prepared, points, pose)
        pairs = Pairs(at.residual, at.weight, at.partner)
        return make_match(
            points,
            start,
            prior,
            SearchEnd(pose, k, change <= tolerance),
            pairs,
            mean_score(points, pairs, settings.scale),
            _information(prepared, at, pose[:2], settings.lone),
            limits,
        )

    def cost(
        self, prepared: Surface, points: Points, pose: Float[Array, "3"], match: Match
    ) -> Float[Array, ""]:
        icp = in_dtype(self, pose.dtype)
        moved = points.position @ se2.rotation(pose[2]).T + pose[None, :2]
        partner = jnp.maximum(match.pair, 0)
        pairs_cost = icp.cost_of_pairs(prepared, moved, partner, match.weight)
        return pairs_cost + prior_cost(match.prior, pose)

    def _pairs(self, of: Surface, points: Points, pose: Array) -> _PairedPoints:
        settings = self.settings
        moved = points.position @ se2.rotation(pose[2]).T + pose[None, :2]
        partner = nearest_points(of.position, moved)
        distance = ((moved - of.position[partner]) ** 2).sum(axis=1)
        possible = points.valid & (distance < settings.reach**2) & self.usable_points(of)[partner]
        residual = jnp.where(possible, self.residual(of, moved, partner), 0.0)
        weight = weights(residual, possible, settings.kernel, settings.scale, settings.trim)
        return _PairedPoints(moved, partner, residual, weight)


def _pose_distance(a: Array, b: Array, length: Array) -> Array:
    """The distance between two poses [m], angles times a length."""
    return jnp.hypot(a[0] - b[0], a[1] - b[1]) + length * jnp.abs(wrap(a[2] - b[2]))


def _information(
    of: Surface, at: _PairedPoints, pivot: Float[Array, "2"], lone: Number | None
) -> Float[Array, "3 3"]:
    """The information Σ w J Jᵀ about the pivot, of partners with a line and partners without.

    A partner without a line has information in all directions: of lines along both axes.
    """
    j, arm = at.partner, at.moved - pivot[None]
    straight = of.straight[j]
    by_lines = information_along(of.normal[j], of.tilt[j], arm, jnp.where(straight, at.weight, 0.0))
    if lone is None:
        return by_lines
    weight = lone**2 * jnp.where(straight, 0.0, at.weight)
    axis = jnp.zeros_like(arm).at[:, 0].set(1.0)
    tilt = jnp.zeros_like(weight)
    return (
        by_lines
        + information_along(axis, tilt, arm, weight)
        + information_along(axis[:, ::-1], tilt, arm, weight)
    )


@record
class PointToPoint(Icp):
    """ICP: the pose that minimizes Σ w |T ∘ p_i - q_j(i)|², q_j(i) the nearest point.

    Each step is the exact minimum for its pairs (`closed_form.minimizer`); its error falls by a
    constant factor a step. Besl & McKay 1992, "A method for registration of 3-D shapes", IEEE
    PAMI 14; Lu & Milios 1997. Lines serve only the status.
    """

    settings: IcpSettings = IcpSettings()

    def residual(self, of: Surface, moved: Array, partner: Array) -> Float[Array, "N"]:
        return distance(of, moved, partner)

    def quadratic(self, of: Surface, pairs: _PairedPoints, middle: Array) -> Quadratic:
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


@record
class PointToLine(Icp):
    """PL-ICP: the pose that minimizes Σ w (n_j · (T ∘ p_i - m_j))², j(i) the nearest point.

    The line (m_j, n_j) is fitted to point j of the reference and its neighbours (`Surface`); each
    step is the exact minimum for its pairs (`closed_form.minimizer`), so that it converges
    quadratically. Censi 2008, "An ICP variant using a point-to-line metric", ICRA, where the line
    joins the two nearest points. Without a line, the residual is `lone` |T ∘ p_i - q_j|.
    """

    settings: IcpSettings = IcpSettings()

    def residual(self, of: Surface, moved: Array, partner: Array) -> Float[Array, "N"]:
        across = (of.normal[partner] * (moved - of.middle[partner])).sum(axis=1)
        lone = self.settings.lone
        if lone is None:
            return across
        return jnp.where(of.straight[partner], across, lone * distance(of, moved, partner))

    def usable_points(self, of: Surface) -> Bool[Array, "M"]:
        return of.straight if self.settings.lone is None else super().usable_points(of)

    def quadratic(self, of: Surface, pairs: _PairedPoints, middle: Array) -> Quadratic:
        j, lone = pairs.partner, self.settings.lone
        by_line, by_point = _weights(of, j, pairs.weight)

        def about(points: Array, weight: Array) -> Array:
            return jnp.where((weight > 0)[:, None], points - middle[None], 0.0)

        source = about(pairs.moved, pairs.weight)
        lines = of_lines(source, about(of.middle[j], by_line), of.normal[j], by_line)
        if lone is None:
            return lines
        points = of_points(source, about(of.position[j], by_point), lone**2 * by_point)
        return add(lines, points)

    def cost_of_pairs(
        self, of: Surface, moved: Array, partner: Array, weight: Array
    ) -> Float[Array, ""]:
        by_line, by_point = _weights(of, partner, weight)
        apart = jnp.where((by_line > 0)[:, None], moved - of.middle[partner], 0.0)
        total = (by_line * (of.normal[partner] * apart).sum(axis=1) ** 2).sum()
        lone = self.settings.lone
        if lone is not None:
            apart = jnp.where((by_point > 0)[:, None], moved - of.position[partner], 0.0)
            total = total + lone**2 * (by_point * (apart**2).sum(axis=1)).sum()
        return 0.5 * total


def _weights(of: Surface, partner: Array, weight: Array) -> tuple[Array, Array]:
    """The weights of pairs with a line, and of those without."""
    straight = of.straight[partner]
    return jnp.where(straight, weight, 0.0), jnp.where(straight, 0.0, weight)
