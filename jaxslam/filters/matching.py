"""Which points of a cluster are which points of a map, by their distances from one another alone.

The cluster's own frame means nothing: a scan of a robot that does not know where it is, or a part
of the map whose place has drifted. Both have a joint covariance, and all of it counts.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam import linalg, se2
from jaxslam.association.gates import mutual
from jaxslam.linalg import check_count
from jaxslam.stats import chi2_quantile

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


class Points(NamedTuple):
    """M cluster points and N map points with their joint covariance."""

    cluster: Array
    """(M, 2)"""
    map: Array
    """(N, 2)"""
    own: Array
    """(M, 2, M, 2)"""
    among: Array
    """(N, 2, N, 2)"""
    shared: Array
    """(M, 2, N, 2) of cluster with map"""
    allowed: Array
    """(M, N) bool: pairs that may be"""


class Limits(NamedTuple):
    """How far a search goes; made by `limits`."""

    single: tuple[float, float]
    """χ² of one and of two degrees of freedom"""
    joint: np.ndarray
    """(M + 1,) χ² of 2n - 3, for n pairs"""
    pairs: int
    candidates: int


def limits(name: str, places: int, probability: float, pairs: int, candidates: int) -> Limits:
    """The limits of a search over M = places cluster points.

    Raises ValueError on a probability not between 0 and 1, or pairs or candidates below 1.
    """
    if not 0 < probability < 1:
        raise ValueError(f"{name}: expected a probability between 0 and 1, got {probability}")
    check_count(f"{name}: pairs", pairs)
    check_count(f"{name}: candidates", candidates)
    joint = [chi2_quantile(probability, max(2 * n - 3, 1)) for n in range(places + 1)]
    single = chi2_quantile(probability, 1), chi2_quantile(probability, 2)
    return Limits(single, np.asarray(joint), pairs, candidates)


def match(points: Points, bounds: Limits) -> Match:
    """The match that explains most cluster points, of several the one of least D².

    Each of a few pairs (a, b) of cluster points, the longest, is held against all pairs (j, l) of
    the map: with s and m the two distances, (s - m)²/var(s - m) <= χ²(1). Each agreement fixes the
    frame T, and the rest of the cluster is judged in it: δ_ik = T z_i - m_k, linear in the errors
    of z_a, z_b, z_i, m_j, m_l and m_k, with d² <= χ²(2) and no point twice. The best hypotheses are
    then fitted as a whole, and lose their worst pair until D² <= χ²(2n - 3).

    No hypothesis (explained = 0, slots -1, the identity) where no two distances agree.
    """
    m, n = points.allowed.shape
    pair_a, pair_b = _longest_pairs(points, bounds.pairs)
    room = min(bounds.candidates, n * n)

    def of_pair(ends: tuple[Array, Array]) -> tuple[Array, Array, Array, Array]:
        a, b = ends
        test, agree = _agreements(points, a, b, bounds.single[0])
        least, best = jax.lax.top_k(-jnp.where(agree, test, jnp.inf).reshape(-1), room)

        def score(one: tuple[Array, Array]) -> tuple[Array, Array, Array]:
            return _score(points, a, b, one[0] // n, one[0] % n, one[1], bounds.single[1])

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


def fit(points: Points, slot: Array, bounds: Limits) -> Match:
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
        by_turn = _across(goal - pose[None, :2])
        eye = jnp.broadcast_to(jnp.eye(2, dtype=z.dtype), (m, 2, 2))
        slope = jnp.where(there[:, None, None], jnp.concatenate([eye, by_turn[:, :, None]], 2), 0.0)
        return residual.reshape(-1), slope.reshape(2 * m, 3), factor, cov, positive

    residual, slope, factor, cov, positive = weigh(pose)
    white, by = linalg.solve_lower(factor, residual), linalg.solve_lower(factor, slope)
    step, solvable = linalg.solve_psd(by.T @ by, by.T @ white)
    pose = pose - step
    left = residual - slope @ step
    own = cov[jnp.arange(m), :, jnp.arange(m)]
    each, _ = _squared(left.reshape(m, 2), own)
    # About the centres the numbers are small; the pose is that of the frames themselves.
    shift = centre_m + pose[:2] - se2.rotation(pose[2]) @ centre_z
    full = jnp.concatenate([shift, jnp.arctan2(jnp.sin(pose[2:]), jnp.cos(pose[2:]))])
    by_turn = jnp.where(there[:, None], _across(target - full[None, :2]), 0.0)
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


def _longest_pairs(points: Points, count: int) -> tuple[Array, Array]:
    """Ends a, b (P,) of long pairs of cluster points, each point's share limited.

    A spurious point far out would be an end of the longest pairs all. So each time a point is used
    halves the length of its further pairs.
    """
    m = points.cluster.shape[0]
    there = points.allowed.any(axis=1)
    delta = points.cluster[:, None] - points.cluster[None, :]
    length = jnp.sqrt((delta**2).sum(axis=2) + jnp.finfo(delta.dtype).tiny)
    usable = there[:, None] & there[None, :] & (jnp.arange(m)[:, None] < jnp.arange(m)[None, :])
    length = jnp.where(usable, length, 0.0)

    def take(used: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        taken, uses = used
        worth = jnp.where(taken, 0.0, length) * 0.5 ** (uses[:, None] + uses[None, :])
        best = jnp.argmax(worth)
        a, b = best // m, best % m
        return (taken.at[a, b].set(True), uses.at[a].add(1).at[b].add(1)), (a, b)

    start = jnp.zeros((m, m), bool), jnp.zeros(m, length.dtype)
    count = min(count, max(m * (m - 1) // 2, 1))
    return jax.lax.scan(take, start, None, length=count)[1]


def _agreements(points: Points, a: Array, b: Array, gate: float) -> tuple[Array, Array]:
    """Of all map pairs (j, l): (s - m)²/var(s - m) (N, N), and whether it is within the gate."""
    eps = jnp.finfo(points.map.dtype).eps
    here = points.cluster[b] - points.cluster[a]
    s = jnp.sqrt((here**2).sum() + jnp.finfo(here.dtype).tiny)
    u = here / s
    there = points.map[None, :] - points.map[:, None]
    length = jnp.sqrt((there**2).sum(axis=2) + jnp.finfo(there.dtype).tiny)
    v = there / length[:, :, None]
    n = length.shape[0]
    every = jnp.arange(n)
    own = points.among[every, :, every]
    mixed = points.among.transpose(0, 2, 1, 3)
    spread = own[:, None] + own[None, :] - mixed - mixed.transpose(0, 1, 3, 2)
    variance = jnp.einsum("jlx,jlxy,jly->jl", v, spread, v)
    at = points.own[jnp.stack([a, b])][:, :, jnp.stack([a, b])]
    near = at[0, :, 0] + at[1, :, 1] - at[0, :, 1] - at[1, :, 0]
    cross = u @ (points.shared[b] - points.shared[a]).reshape(2, -1)
    cross = cross.reshape(n, 2)
    both = (v * (cross[None, :] - cross[:, None])).sum(axis=2)
    # Exact points may differ by what rounding leaves of their distance.
    variance = variance + u @ near @ u - 2 * both + (8 * eps * (s + length)) ** 2
    test = (s - length) ** 2 / jnp.maximum(variance, jnp.finfo(s.dtype).tiny)
    possible = points.allowed[a][:, None] & points.allowed[b][None, :]
    possible = possible & (every[:, None] != every[None, :]) & (a != b)
    # A pair no longer than its own uncertainty has no direction.
    directed = (s**2 > 9 * u @ near @ u) & (s > 0)
    return test, possible & directed & (variance > 0) & (test <= gate)


def _score(
    points: Points, a: Array, b: Array, j: Array, k: Array, test: Array, gate: float
) -> tuple[Array, Array, Array]:
    """Slots (M,) that cluster points have if a is j and b is k, how many, and Σ d²; see `match`."""
    m, n = points.allowed.shape
    here, there = points.cluster[b] - points.cluster[a], points.map[k] - points.map[j]
    tiny = jnp.finfo(here.dtype).tiny
    s, length = jnp.sqrt((here**2).sum() + tiny), jnp.sqrt((there**2).sum() + tiny)
    u, v = here / s, there / length
    c, d = (u * v).sum(), u[0] * v[1] - u[1] * v[0]
    rotation = jnp.stack([jnp.stack([c, -d]), jnp.stack([d, c])])
    middle = 0.5 * (points.cluster[a] + points.cluster[b])
    arm = (points.cluster - middle[None, :]) @ rotation.T
    placed = arm + 0.5 * (points.map[j] + points.map[k])[None, :]
    # dθ = v⊥·(δm_k - δm_j)/|m| - v⊥·R(δz_b - δz_a)/|s|, and T z_i moves by arm⊥ dθ.
    swing = _across(arm)[:, :, None] * _across(v)[None, None, :]
    half = 0.5 * jnp.eye(2, dtype=arm.dtype)[None]
    by_map = jnp.stack([half - swing / length, half + swing / length], axis=1)
    by_ends = jnp.stack([-half + swing / s, -half - swing / s], axis=1) @ rotation
    ends, slots = jnp.stack([a, b]), jnp.stack([j, k])
    # Errors of T z_i are G of those of z_a, z_b, m_j, m_k, plus R of its own.
    g = jnp.concatenate([by_ends, by_map], axis=1).transpose(0, 2, 1, 3).reshape(m, 2, 8)
    own_ends = points.own[ends].reshape(4, m, 2)
    own_map = points.shared[:, :, slots].reshape(m, 2, 4).transpose(2, 0, 1)
    with_own = jnp.concatenate([own_ends, own_map]).transpose(1, 0, 2)  # (m, 8, 2)
    mixed = points.shared[ends][:, :, slots].reshape(4, 4)
    top = jnp.concatenate([points.own[ends][:, :, ends].reshape(4, 4), mixed], axis=1)
    low = jnp.concatenate([mixed.T, points.among[slots][:, :, slots].reshape(4, 4)], axis=1)
    base = jnp.concatenate([top, low])
    every = jnp.arange(m)
    alone = rotation @ points.own[every, :, every] @ rotation.T
    crossed = g @ with_own @ rotation.T
    cov = g @ base @ g.transpose(0, 2, 1) + alone + crossed + crossed.transpose(0, 2, 1)
    rows = jnp.concatenate(
        [points.shared[ends].reshape(4, n * 2), points.among[slots].reshape(4, -1)]
    )
    with_map = (g.reshape(2 * m, 8) @ rows).reshape(m, 2, n, 2)
    with_map = with_map + jnp.einsum("xy,iynw->ixnw", rotation, points.shared)
    with_map = with_map.transpose(0, 2, 1, 3)
    at = jnp.arange(n)
    spread = cov[:, None] + points.among[at, :, at][None] - with_map
    spread = spread - with_map.transpose(0, 1, 3, 2)
    distance, regular = _squared(placed[:, None] - points.map[None, :], spread)
    free = (every != a) & (every != b)
    left = (at != j) & (at != k)
    fits = points.allowed & regular & (distance <= gate) & free[:, None] & left[None, :]
    slot = mutual(distance, fits)
    sum_of = jnp.where(slot >= 0, distance[every, jnp.maximum(slot, 0)], 0.0).sum()
    slot = slot.at[a].set(j.astype(jnp.int32)).at[b].set(k.astype(jnp.int32))
    agreed = jnp.isfinite(test)
    slot = jnp.where(agreed, slot, -1)
    return slot, (slot >= 0).sum(), jnp.where(agreed, test + sum_of, 0.0)


def _across(points: Array) -> Array:
    """(..., 2) turned by 90°."""
    return jnp.stack([-points[..., 1], points[..., 0]], axis=-1)


def _squared(error: Array, cov: Array) -> tuple[Array, Array]:
    """eᵀ P⁻¹ e of (…, 2) and (…, 2, 2), and whether P is positive definite; 0 where it is not."""
    p, q, r = cov[..., 0, 0], cov[..., 1, 1], cov[..., 0, 1]
    det = p * q - r * r
    regular = (p > 0) & (q > 0) & (det > 4 * jnp.finfo(cov.dtype).eps * p * q)
    x, y = error[..., 0], error[..., 1]
    squared = (q * x * x - 2 * r * x * y + p * y * y) / jnp.where(regular, det, 1.0)
    return jnp.where(regular, squared, 0.0), regular
