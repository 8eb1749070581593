"""The base class of matchers and its result; `match` calls a matcher outside traces."""

from enum import IntEnum
from functools import partial
from typing import Any, ClassVar, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree
from numpy.typing import ArrayLike

from jaxslam.core._numbers import is_concrete
from jaxslam.core._reprs import shape_text
from jaxslam.core.protocols import Component
from jaxslam.core.validation import Check, InvalidField, instance_of, refusals_of, require
from jaxslam.laser.grids._grid import Grid, grid_map
from jaxslam.laser.matching._point_sets import Points, Prior
from jaxslam.math._arrays import in_dtype
from jaxslam.math._definite import is_asymmetric, is_indefinite

Reference: TypeAlias = Points | Grid


class MatchStatus(IntEnum):
    """The outcome of a match; of several that apply the last counts."""

    CONVERGED = 0
    """The pose no longer changes."""
    NOT_CONVERGED = 1
    """It ended at its limit of iterations."""
    AMBIGUOUS = 2
    """Another pose of the window, apart from this one, fits almost as well."""
    DEGENERATE = 3
    """The scans do not determine the motion along `Match.weakest`; the pose is usable across it."""
    UNLIKE = 4
    """The score is too low: few points have a partner, or they lie far from it."""
    TOO_FEW = 5
    """Too few points have a partner; the pose is the start."""


class Match(NamedTuple):
    """The pose of a scan in the frame of its reference, and how well it is determined."""

    pose: Float[Array, "3"]
    """T of the scan's frame in the reference's frame, so that T ∘ p lies on the reference"""
    status: Int[Array, ""]
    """a `MatchStatus`"""
    iterations: Int[Array, ""]
    """steps taken; of `Correlative` the blocks of the lattice that were divided"""
    residual: Float[Array, ""]
    """weighted root mean square of the residuals that took part [m]"""
    inliers: Float[Array, ""]
    """share of the valid points of the scan that took part, in [0, 1]"""
    score: Float[Array, ""]
    """mean of exp(-½ (e/s)²) over the scan's valid points, 0 for one without partner: in [0, 1]"""
    information: Float[Array, "3 3"]
    """Σ w J Jᵀ of the residuals across the reference's surface, in metres, by (x, y, θ)"""
    weakest: Float[Array, "3"]
    """(dx, dy, dθ), of unit length where dθ is times the RMS range: the least eigenvector of the
    information"""
    condition: Float[Array, ""]
    """least eigenvalue of the information over the largest, lengths in RMS ranges"""
    determined: Float[Array, "3 3"]
    """projection of a motion (dx, dy, dθ) onto the determined directions: the identity, unless the
    match is DEGENERATE"""
    pair: Int[Array, "N"]
    """index of the partner of each point in the reference, -1 without; in a grid 0 for inliers"""
    weight: Float[Array, "N"]
    """weight of each point; 0 for rejected points"""
    prior: Prior | None = None
    """prior of the search"""


class Matcher(Component):
    """A way to match a scan to a reference; a subclass is a record.

    The methods are pure and of one pair: vmap them.
    """

    of_grid: ClassVar[bool] = False
    """whether the reference is a `Grid`, else `Points`"""

    def __post_init__(self) -> None:
        prepared = "prepared, points"
        methods = {"prepare": "reference", "match": f"{prepared}, start, prior"}
        self._check(Matcher, methods | {"cost": f"{prepared}, pose, match"})

    def prepare(self, reference: PyTree) -> PyTree:
        """The pytree of arrays that `match` needs of a reference, once for all scans."""
        raise NotImplementedError

    def match(
        self,
        prepared: PyTree,
        points: Points,
        start: Float[Array, "3"],
        prior: Prior | None = None,
    ) -> Match:
        """The match of a scan; its while loops have forward derivatives only."""
        raise NotImplementedError

    def cost(
        self, prepared: PyTree, points: Points, pose: Float[Array, "3"], match: Match
    ) -> Float[Array, ""]:
        """The cost ½ Σ w e² [m²] and the prior's, with the pairs, weights and prior of a match.

        Differentiable by the pose, the points, and by the reference through `prepare`.
        """
        raise NotImplementedError


def match(
    matcher: Matcher,
    reference: Reference,
    points: Points,
    start: ArrayLike,
    prior: Prior | None = None,
) -> Match:
    """The match of a scan to a reference.

    Args:
        reference: `Points`, or a `Grid` where `matcher.of_grid`; with a leading axis on all of its
            arrays for many pairs at once, as `points` and `start` then have.
        start: (3,) where the search begins.
        prior: of the pose; without a prior only the start is known.

    It is computed in the higher precision of reference and points.

    Raises:
        ValueError: a reference of another kind, arrays that do not fit each other, numbers that
            are not finite. A scan without points is a status.
    """
    with refusals_of("match"):
        batch = _batch_of(matcher, reference, points, start)
        if prior is not None:
            require("prior", prior, instance_of(Prior))
            if np.shape(prior.pose) != (*batch, 3) or np.shape(prior.information) != (*batch, 3, 3):
                size = " x ".join(str(axis) for axis in (*batch, 3))
                raise InvalidField(
                    "prior",
                    f"expected a pose {size} and an information {size} x 3, got "
                    f"{shape_text(prior.pose)} and {shape_text(prior.information)}",
                )
            if is_concrete(prior):
                mean, information = np.asarray(prior.pose), np.asarray(prior.information)
                if not (np.all(np.isfinite(mean)) and np.all(np.isfinite(information))):
                    raise InvalidField("prior", "expected finite numbers")
                # 1e-4: the inverse of a covariance in float32 may have few digits.
                if is_asymmetric(information, 1e-4).any() or is_indefinite(information, 1e-4).any():
                    reason = "expected a symmetric information, positive semi-definite"
                    raise InvalidField("prior", reason)
    with jax.numpy_dtype_promotion("standard"):  # the user may have refused promotion: "strict"
        dtype = jnp.result_type(points.position, *floats(reference), jnp.float32)
    start = jnp.asarray(start, dtype)
    reference, points, prior = in_dtype((reference, points, prior), dtype)
    result: Match = (_match_many if batch else _match)(matcher, reference, points, start, prior)
    return result


def floats(tree: PyTree) -> list[Array]:
    """The arrays of a tree that hold real numbers."""
    leaves = jax.tree.leaves(tree)
    return [leaf for leaf in leaves if jnp.issubdtype(jnp.result_type(leaf), jnp.floating)]


@partial(jax.jit, inline=True)
def _match(
    matcher: Matcher, reference: Reference, points: Points, start: Array, prior: Prior | None
) -> Match:
    return matcher.match(matcher.prepare(reference), points, start, prior)


@partial(jax.jit, inline=True)
def _match_many(
    matcher: Matcher, reference: Reference, points: Points, start: Array, prior: Prior | None
) -> Match:
    # Grids one after another: loops over cells are slow side by side.
    prepare_all = (
        partial(jax.lax.map, matcher.prepare) if matcher.of_grid else jax.vmap(matcher.prepare)
    )
    return jax.vmap(matcher.match)(prepare_all(reference), points, start, prior)


def _batch_of(
    matcher: Matcher, reference: Reference, points: Points, start: ArrayLike
) -> tuple[int, ...]:
    """The leading axis of the arguments, () of a pair; InvalidField on what `match` refuses."""
    require("matcher", matcher, instance_of(Matcher))
    kind = Grid if matcher.of_grid else Points
    require("reference", reference, instance_of(kind, f"; {matcher.name} takes {kind.__name__}"))
    batch: tuple[int, ...] = np.shape(start)[:-1]
    if len(batch) > 1 or np.shape(start)[-1:] != (3,):
        raise InvalidField("start", f"expected poses (x, y, θ), got {shape_text(start)}")
    require("points", points, _points_of(batch))
    if isinstance(reference, Points):
        require("reference", reference, _points_of(batch))
        if not reference.valid.shape[-1]:
            raise InvalidField("reference", "expected at least one point, valid or not")
    elif not batch:
        require("reference", reference, grid_map)
    elif np.ndim(reference.log_odds) != 3 or len(reference.log_odds) != batch[0]:
        got = shape_text(reference.log_odds)
        raise InvalidField("reference", f"expected {batch[0]} grids, got log-odds of {got}")
    if is_concrete(start) and not np.all(np.isfinite(np.asarray(start))):
        raise InvalidField("start", f"expected finite numbers, got {np.asarray(start)}")
    return batch


def _points_of(batch: tuple[int, ...]) -> Check:
    """The check of finite `Points` with these leading axes."""

    def check(value: Any) -> Points:
        points: Points = instance_of(Points)(value)
        shape = np.shape(points.valid)
        if (
            len(shape) != len(batch) + 1
            or shape[:-1] != batch
            or any(np.shape(part) != (*shape, 2) for part in points[:2])
        ):
            shapes = ", ".join(shape_text(part) for part in points)
            expected = " x ".join(str(size) for size in (*batch, "N"))
            raise ValueError(f"expected {expected} positions, rays and masks, got {shapes}")
        if is_concrete(points) and not all(np.isfinite(np.asarray(p)).all() for p in points[:2]):
            raise ValueError("expected finite points; those that are not valid, too")
        return points

    return check
