"""Pairs of cluster points against pairs of map points: `filters.matching`'s hypotheses."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.association.gates import mutual


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


def longest_pairs(points: Points, count: int) -> tuple[Array, Array]:
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


def agreements(points: Points, a: Array, b: Array, gate: float) -> tuple[Array, Array]:
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
    there_covs = difference_covs(own, own, points.among.transpose(0, 2, 1, 3))
    variance = jnp.einsum("jlx,jlxy,jly->jl", v, there_covs, v)
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


def scored(
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
    swing = across(arm)[:, :, None] * across(v)[None, None, :]
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
    error_covs = difference_covs(cov, points.among[at, :, at], with_map)
    distance, regular = squared(placed[:, None] - points.map[None, :], error_covs)
    free = (every != a) & (every != b)
    left = (at != j) & (at != k)
    fits = points.allowed & regular & (distance <= gate) & free[:, None] & left[None, :]
    slot = mutual(distance, fits)
    sum_of = jnp.where(slot >= 0, distance[every, jnp.maximum(slot, 0)], 0.0).sum()
    slot = slot.at[a].set(j.astype(jnp.int32)).at[b].set(k.astype(jnp.int32))
    agreed = jnp.isfinite(test)
    slot = jnp.where(agreed, slot, -1)
    return slot, (slot >= 0).sum(), jnp.where(agreed, test + sum_of, 0.0)


def across(points: Array) -> Array:
    """(..., 2) turned by 90°."""
    return jnp.stack([-points[..., 1], points[..., 0]], axis=-1)


def squared(error: Array, cov: Array) -> tuple[Array, Array]:
    """eᵀ P⁻¹ e of (…, 2) and (…, 2, 2), and whether P is positive definite; 0 where it is not."""
    p, q, r = cov[..., 0, 0], cov[..., 1, 1], cov[..., 0, 1]
    det = p * q - r * r
    regular = (p > 0) & (q > 0) & (det > 4 * jnp.finfo(cov.dtype).eps * p * q)
    x, y = error[..., 0], error[..., 1]
    squared = (q * x * x - 2 * r * x * y + p * y * y) / jnp.where(regular, det, 1.0)
    return jnp.where(regular, squared, 0.0), regular


def difference_covs(
    a: Float[Array, "M 2 2"], b: Float[Array, "N 2 2"], cross: Float[Array, "M N 2 2"]
) -> Float[Array, "M N 2 2"]:
    """cov(x_i - y_j) of all pairs, by the covariances of x, of y and of x_i with y_j."""
    return a[:, None] + b[None] - cross - cross.transpose(0, 1, 3, 2)
