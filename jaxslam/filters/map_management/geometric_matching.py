"""Which points of a cluster are which points of a map, by their distances from one another alone.

The cluster's own frame means nothing: a scan of a robot that does not know where it is, or a part
of the map whose place has drifted. Both have a joint covariance, and all of it counts.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.filters.map_management.point_pairs import (
    Points,
    across,
    agreements,
    longest_pairs,
    scored,
    squared,
)
from jaxslam.math import linalg, se2
from jaxslam.math.linalg import check_count
from jaxslam.math.stats import chi2_quantile

Array = jax.Array

_BLOCK = 32  # candidates that are scored together; more cost memory
_FINALISTS = 8  # hypotheses that are tried jointly


class Match(NamedTuple):
    """The best match of M cluster points with N map points."""

    pose: Array
    """(3,) T with map = T ∘ cluster, by generalized least squares over the pairs"""
    slot: Array
    """(M,) int32: the map point of each cluster point, -1 for none"""
    explained: Array
    """() int: pairs that fit jointly"""
    distance: Array
    """() D² of these, χ² of 2·explained - 3 degrees of freedom"""
    runner_up: Array
    """() int: most pairs of any other hypothesis, one that shares fewer than two pairs"""
    exhausted: Array
    """() bool: more pairs of points agreed than there was room for"""


class SearchLimits(NamedTuple):
    """How far a search goes; made by `search_limits`."""

    single: tuple[float, float]
    """χ² of one and of two degrees of freedom"""
    joint: np.ndarray
    """(M + 1,) χ² of 2n - 3, for n pairs"""
    pairs: int
    candidates: int


def search_limits(
    caller: str, size: int, probability: float, pairs: int, candidates: int
) -> SearchLimits:
    """The limits of a search over M = size cluster points.

    Raises ValueError, which names the caller, on a probability not between 0 and 1, or pairs or
    candidates below 1.
    """
    if not 0 < probability < 1:
        raise ValueError(f"{caller}: expected a probability between 0 and 1, got {probability}")
    check_count(f"{caller}: pairs", pairs)
    check_count(f"{caller}: candidates", candidates)
    joint = [chi2_quantile(probability, max(2 * n - 3, 1)) for n in range(size + 1)]
    single = chi2_quantile(probability, 1), chi2_quantile(probability, 2)
    return SearchLimits(single, np.asarray(joint), pairs, candidates)


def match(points: Points, bounds: SearchLimits) -> Match:
    """The match that explains most cluster points, of several the one of least D².

    Each of a few pairs (a, b) of cluster points, the longest, is held against all pairs (j, l) of
    the map: with s and m the two distances, (s - m)²/var(s - m) <= χ²(1). Each agreement fixes the
    frame T, and the rest of the cluster is judged in it: δ_ik = T z_i - m_k, linear in the errors
    of z_a, z_b, z_i, m_j, m_l and m_k, with d² <= χ²(2) and no point twice. The best hypotheses are
    then fitted as a whole, and lose their worst pair until D² <= χ²(2n - 3).

    No hypothesis (explained = 0, slots -1, the identity) where no two distances agree.
    """
    m, n = points.allowed.shape
    pair_a, pair_b = longest_pairs(points, bounds.pairs)
    room = min(bounds.candidates, n * n)

    def of_pair(ends: tuple[Array, Array]) -> tuple[Array, Array, Array, Array]:
        a, b = ends
        test, agree = agreements(points, a, b, bounds.single[0])
        least, best = jax.lax.top_k(-jnp.where(agree, test, jnp.inf).reshape(-1), room)

        def score(one: tuple[Array, Array]) -> tuple[Array, Array, Array]:
            return scored(points, a, b, one[0] // n, one[0] % n, one[1], bounds.single[1])

        slot, count, distance = jax.lax.map(score, (best, -least), batch_size=min(_BLOCK, room))
        return slot, count, distance, agree.sum() > room

    slot, count, distance, cut = jax.lax.map(of_pair, (pair_a, pair_b))
    slot, count, distance = slot.reshape(-1, m), count.reshape(-1), distance.reshape(-1)
    # Many pairs first, then a small distance, in one number.
    merit = count - distance / (1 + distance)
    # The best alone would all be one hypothesis, found from each of its pairs: one a pair first.
    spread = merit.reshape(pair_a.shape[0], -1)
    heads = spread.argmax(axis=1) + jnp.arange(pair_a.shape[0]) * spread.shape[1]
    chosen = jnp.concatenate([heads, jax.lax.top_k(merit, min(_FINALISTS, len(merit)))[1]])
    fits = jax.vmap(lambda slot: fit(points, slot, bounds))(slot[chosen])
    refined = fits.explained - fits.distance / (1 + fits.distance)
    best: Match = jax.tree.map(lambda leaf: leaf[jnp.argmax(refined)], fits)
    same = ((slot == best.slot[None, :]) & (slot >= 0)).sum(axis=1)
    other = jnp.where(same < 2, count, 0).max()
    return best._replace(runner_up=other.astype(jnp.int32), exhausted=cut.any())


def fit(points: Points, slot: Array, bounds: SearchLimits) -> Match:
    """One hypothesis as a whole: the frame by least squares, without pairs that do not fit.

    r_i = T z_i - m_i over the pairs, Σ their joint covariance: min rᵀ Σ⁻¹ r over T, to first order
    about the unweighted closed form. The pair of largest r_iᵀ Σ_ii⁻¹ r_i goes until D² <= χ²(2n-3).
    """
    m = points.cluster.shape[0]
    levels = jnp.asarray(bounds.joint, points.cluster.dtype)

    def drop(_: int, slot: Array) -> Array:
        solved = solve(points, slot)
        count = (slot >= 0).sum()
        over = (solved.distance > levels[count]) & (count > 2)
        worst = jnp.argmax(solved.each)
        return jnp.where(over & (jnp.arange(m) == worst), -1, slot)

    # Two pairs always have one degree of freedom, which the agreement of distances has tested.
    slot = jax.lax.fori_loop(0, max(m - 2, 0), drop, slot)
    solved = solve(points, slot)
    count = (slot >= 0).sum()
    ok = (count >= 2) & solved.regular & (solved.distance <= levels[count])
    none = jnp.zeros((), jnp.int32)
    return Match(
        pose=jnp.where(ok, solved.pose, 0.0),
        slot=jnp.where(ok, slot, -1),
        explained=jnp.where(ok, count, 0).astype(jnp.int32),
        distance=jnp.where(ok, solved.distance, 0.0),
        runner_up=none,
        exhausted=jnp.asarray(False),
    )


class Solved(NamedTuple):
    """A weighted alignment."""

    pose: Array
    """(3,)"""
    distance: Array
    """() D²"""
    each: Array
    """(M,) r_iᵀ Σ_ii⁻¹ r_i of the pairs, else 0"""
    regular: Array
    """() bool: Σ is positive definite, and the pose is determined"""
    residual: Array
    """(2M,) r at the pose, to first order"""
    slope: Array
    """(2M, 3) ∂r/∂T"""
    factor: Array
    """(2M, 2M) Cholesky factor of Σ; the identity for what is no pair"""


def solve(points: Points, slot: Array) -> Solved:
    """The pose that aligns cluster points with their map points (M,), -1 for none.

    The closed form without weights, and from there one step of generalized least squares. More
    steps would each be linearized where the last has left the map behind, and wander along what it
    knows worst. For the same reason ∂r/∂θ is taken where the map puts the points, (m - t)⊥ and not
    (R z)⊥, which differ by the residual: then a turn of the whole map turns the pose with it, and
    no residual tells about it.
    """
    m = slot.shape[0]
    there, at = slot >= 0, jnp.maximum(slot, 0)
    target = points.map[at]
    among = points.among[at][:, :, at]
    shared = points.shared[:, :, at]
    weight = jnp.where(there, 1.0, 0.0).astype(target.dtype)
    total = jnp.maximum(weight.sum(), 1.0)
    centre_z = (weight[:, None] * points.cluster).sum(axis=0) / total
    centre_m = (weight[:, None] * target).sum(axis=0) / total
    z, goal = points.cluster - centre_z[None, :], target - centre_m[None, :]
    dot = (weight[:, None] * z * goal).sum()
    turn = (weight * (z[:, 0] * goal[:, 1] - z[:, 1] * goal[:, 0])).sum()
    pose = jnp.concatenate([jnp.zeros(2, z.dtype), se2.polar(jnp.stack([dot, turn]))[1:]])
    both = (there[:, None, None, None] & there[None, None, :, None]) | jnp.zeros((m, 2, m, 2), bool)
    unit = jnp.eye(2 * m, dtype=z.dtype).reshape(m, 2, m, 2)

    def weigh(pose: Array) -> tuple[Array, Array, Array, Array, Array]:
        rotation = se2.rotation(pose[2])
        turned = z @ rotation.T
        mixed = jnp.einsum("xy,iyjw->ixjw", rotation, shared)
        cov = jnp.einsum("xy,iyjw,vw->ixjv", rotation, points.own, rotation)
        cov = cov + among - mixed - mixed.transpose(2, 3, 0, 1)
        cov = jnp.where(both, cov, unit)
        factor, positive = linalg.cholesky(linalg.symmetrize(cov.reshape(2 * m, 2 * m)))
        residual = jnp.where(there[:, None], turned + pose[None, :2] - goal, 0.0)
        by_turn = across(goal - pose[None, :2])
        eye = jnp.broadcast_to(jnp.eye(2, dtype=z.dtype), (m, 2, 2))
        slope = jnp.where(there[:, None, None], jnp.concatenate([eye, by_turn[:, :, None]], 2), 0.0)
        return residual.reshape(-1), slope.reshape(2 * m, 3), factor, cov, positive

    residual, slope, factor, cov, positive = weigh(pose)
    white, by = linalg.solve_lower(factor, residual), linalg.solve_lower(factor, slope)
    step, solvable = linalg.solve_psd(by.T @ by, by.T @ white)
    pose = pose - step
    left = residual - slope @ step
    own = cov[jnp.arange(m), :, jnp.arange(m)]
    each, _ = squared(left.reshape(m, 2), own)
    # About the centres the numbers are small; the pose is that of the frames themselves.
    shift = centre_m + pose[:2] - se2.rotation(pose[2]) @ centre_z
    full = jnp.concatenate([shift, jnp.arctan2(jnp.sin(pose[2:]), jnp.cos(pose[2:]))])
    by_turn = jnp.where(there[:, None], across(target - full[None, :2]), 0.0)
    slope = slope.at[:, 2].set(by_turn.reshape(-1))
    return Solved(
        pose=full,
        distance=((white - by @ step) ** 2).sum(),
        each=jnp.where(there, each, 0.0),
        regular=positive & solvable,
        residual=left,
        slope=slope,
        factor=factor,
    )
