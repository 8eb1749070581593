"""The loop that the iterative closest point methods share: pairs, a closed-form step, again."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.graphs.solver.kernels import Kernel
from jaxslam.matching.correspondences import Rule, nearest, weights
from jaxslam.matching.matcher import Match, Matcher
from jaxslam.matching.outcome import Limits, concluded, determined, information_of, length_of
from jaxslam.matching.points import Points
from jaxslam.matching.surface import Surface, surface
from jaxslam.math import se2
from jaxslam.math.angles import wrap


class Pairs(NamedTuple):
    """A scan at a pose, and its partners."""

    moved: Float[Array, "N 2"]
    """the points of the scan in the frame of the reference"""
    partner: Int[Array, "N"]
    residual: Float[Array, "N"]
    """not below 0 for point-to-point [m]"""
    weight: Float[Array, "N"]


class Metric(NamedTuple):
    """What an ICP minimizes."""

    residual: Callable[[Surface, Array, Array], Array]
    """(surface, moved points, partners) -> (N,) [m]"""
    usable: Callable[[Surface], Bool[Array, "M"]]
    """which points of the reference may be partners"""
    step: Callable[[Surface, Pairs, Array], Array]
    """(surface, pairs, middle (2,)) -> the motion about the middle that minimizes Σ w e²"""
    cost: Callable[[Surface, Array, Array, Array], Array]
    """(surface, moved points, partners, weights) -> ½ Σ w e²"""


def icp(
    name: str,
    metric: Metric,
    *,
    reach: float,
    trim: float,
    kernel: Kernel | None,
    scale: float,
    span: int,
    gap: float,
    iterations: int,
    tolerance: float,
    limits: Limits,
) -> Matcher:
    """The matcher of a metric; see `point_to_line` for the arguments. Raises ValueError on them."""
    if not (reach > 0 and 0 < trim <= 1 and scale > 0 and gap > 0 and tolerance > 0):
        raise ValueError(
            f"{name}: expected reach, scale, gap and tolerance above 0 and trim in (0, 1], got "
            f"{reach}, {scale}, {gap}, {tolerance}, {trim}"
        )
    if span < 1 or iterations < 1:
        raise ValueError(f"{name}: expected span and iterations >= 1, got {span}, {iterations}")
    rule = Rule(reach, trim, kernel, scale)

    def pairs_at(of: Surface, points: Points, pose: Array) -> Pairs:
        moved = points.position @ se2.rotation(pose[2]).T + pose[None, :2]
        partner = nearest(of.position, moved)
        distance = ((moved - of.position[partner]) ** 2).sum(axis=1)
        possible = points.valid & (distance < reach**2) & metric.usable(of)[partner]
        residual = jnp.where(possible, metric.residual(of, moved, partner), 0.0)
        return Pairs(moved, partner, residual, weights(rule, residual, possible))

    def match(of: Surface, points: Points, start: Array) -> Match:
        length = length_of(points)

        def unfinished(state: Any) -> Array:
            k, _, _, change = state
            return jnp.asarray((k < iterations) & (change > tolerance))

        def step(state: Any) -> Any:
            k, pose, before, _ = state
            pairs = pairs_at(of, points, pose)
            total = pairs.weight.sum()
            middle = pairs.weight @ pairs.moved / jnp.where(total > 0, total, 1.0)
            moved = metric.step(of, pairs, middle)
            moved = determined(moved, _information(of, pairs, middle), length, limits.condition)
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
            information=_information(of, at, pose[:2]),
            spread=scale,
            iterations=k,
            converged=change <= tolerance,
            limits=limits,
        )

    def cost(of: Surface, points: Points, pose: Array, found: Match) -> Array:
        moved = points.position @ se2.rotation(pose[2]).T + pose[None, :2]
        return metric.cost(of, moved, jnp.maximum(found.pair, 0), found.weight)

    return Matcher(name, lambda reference: surface(reference, span, gap), match, cost)


def _size(a: Array, b: Array, length: Array) -> Array:
    """How far two poses are apart [m]."""
    return jnp.hypot(a[0] - b[0], a[1] - b[1]) + length * jnp.abs(wrap(a[2] - b[2]))


def _information(of: Surface, at: Pairs, pivot: Float[Array, "2"]) -> Float[Array, "3 3"]:
    """Σ w J Jᵀ with J = (n, n·∂(R p)/∂θ), turned about the pivot, over partners that have a line.

    A normal that is turned by noise of variance τ² has E n̂n̂ᵀ = (1 - τ²) nnᵀ + τ² ttᵀ, t along the
    line, which feigns information along a wall; hence the sum of (1 + τ²) n̂n̂ᵀ - τ² ttᵀ.
    """
    n, tilt = of.normal[at.partner], of.tilt[at.partner]
    arm = at.moved - pivot[None]
    t = jnp.stack([n[:, 1], -n[:, 0]], axis=-1)
    weight = jnp.where(of.straight[at.partner], at.weight, 0.0)

    def along(v: Array) -> Array:
        turn = v[:, 1] * arm[:, 0] - v[:, 0] * arm[:, 1]
        return jnp.concatenate([v, turn[:, None]], axis=1)

    both = information_of(along(n), weight * (1 + tilt))
    return both - information_of(along(t), weight * tilt)
