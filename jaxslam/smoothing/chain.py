"""The affine Gaussian problem of a path and a map, solved backward along the path.

Poses form a chain and landmarks stand still, so the least-squares problem of T poses and N
landmarks needs no matrix larger than the map's. Backward, the information that the future holds on
(pose, map) is carried from pose to pose, and the noise of each motion is eliminated: its optimum is
an affine function of where the motion leads and of the map. What remains at the start is the map.
Forward, these functions give the path (`marginals`). It is dynamic programming; among smoothers the
one of backward information and forward means (Mayne 1966, "A solution of the smoothing problem for
linear dynamic systems", Automatica 4(2); Fraser & Potter 1969, IEEE TAC 14(4)).

No covariance of a motion, of the start or of a pose is inverted, so all may be singular; no prior
of a landmark is needed, so it does not matter when one is born; and covariances come out as sums of
squares. O(T N²) time, and O(T N) memory beside a few matrices of N².
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.math import linalg

Array = jax.Array


class Start(NamedTuple):
    """δx_0 = L d_0, at a cost of ½ |ξ̄ + d_0|²."""

    root: Array
    """(3, 3) L, with L Lᵀ the covariance of the start"""
    noise: Array
    """(3,) ξ̄"""


class Step(NamedTuple):
    """A motion and the scan after it, as deviations δ from a reference path x̄ and map m̄.

        δx_t = F δx_{t-1} + c + G d_t    ½ |η̄ + d_t|²
        b = A δx_t + B δl_slot + e       ½ |e|²

    Noises are in units of their own standard deviations: the roots of their covariances are within
    G; and so are e, b, A, B. Rows of zeros say nothing. M places, Z rows a place.
    """

    by_pose: Array
    """(3, 3) F"""
    by_noise: Array
    """(3, W) G"""
    drift: Array
    """(3,) c: where the motion leads from the reference, minus the next reference"""
    noise: Array
    """(W,) η̄"""
    slot: Array
    """(M,) int of the landmark seen; anything where the rows are zeros"""
    pose_rows: Array
    """(M, Z, 3) A"""
    landmark_rows: Array
    """(M, Z, L) B"""
    residual: Array
    """(M, Z) b"""


class Chain(NamedTuple):
    """The cost of a path and a map: all of it is a sum of the squares that its parts name."""

    start: Start
    steps: Step
    """with leading T"""


class Gain(NamedTuple):
    """The optimal noise d = k - J a - K δm, with a where the motion leads, F δx + c."""

    constant: Array
    """(W,) k"""
    by_pose: Array
    """(W, 3) J"""
    by_map: Array
    """(W, NL) K"""
    factor: Array
    """(W, W) lower, of M = I + Gᵀ Λ G; M⁻¹ is the covariance of d for given a and δm"""


class Policy(NamedTuple):
    """The solution: what every noise should be, and the map."""

    start: Gain
    """of d_0, where a = 0"""
    steps: Gain
    """with leading T"""
    landmarks: Array
    """(N, L) δm"""
    map_factor: Array
    """(NL, NL) lower Cholesky factor of the information on the map, 1 at dead slots"""
    decrement: Array
    """() λ²: where c = 0, twice what the optimum is below the reference's cost, and the squared
    length of the way there in posterior standard deviations (the Newton decrement)"""
    regular: Array
    """() bool: the information on the map is positive definite"""


class _Ahead(NamedTuple):
    """½ aᵀ Λ a - aᵀ y + constant: the least cost of all that comes, by a = (δpose, δmap)."""

    pose: Array
    """(3, 3) of Λ"""
    cross: Array
    """(3, NL)"""
    map: Array
    """(NL, NL)"""
    pose_y: Array
    """(3,) of y"""
    map_y: Array
    """(NL,)"""


def eliminate(chain: Chain, alive: Array) -> Policy:
    """Solve the chain. alive: (N,) bool, the landmarks that are measured at all.

    With Λ and y of what comes after motion t, its noise costs min over d of ½ |η̄ + d|² plus
    ½ (a + G d)ᵀ Λ (a + G d) - (a + G d)ᵀ y: at d = M⁻¹ (Gᵀ y - η̄ - Gᵀ Λ a), M = I + Gᵀ Λ G, which
    leaves Λ - Λ G M⁻¹ Gᵀ Λ and y - Λ G M⁻¹ (Gᵀ y - η̄); then a = F δx + c is put in.
    """
    capacity, size = alive.shape[0], chain.steps.landmark_rows.shape[3]
    wide, kind = capacity * size, chain.steps.residual.dtype

    def back(carry: tuple[_Ahead, Array], step: Step) -> tuple[tuple[_Ahead, Array], Gain]:
        ahead, gain, gained = _without_noise(
            _measured(carry[0], step, capacity), step.by_noise, step.noise
        )
        behind = _Ahead(
            pose=linalg.symmetrize(step.by_pose.T @ ahead.pose @ step.by_pose),
            cross=linalg.matmul(step.by_pose.T, ahead.cross),
            map=ahead.map,
            pose_y=step.by_pose.T @ (ahead.pose_y - ahead.pose @ step.drift),
            map_y=ahead.map_y - step.drift @ ahead.cross,
        )
        return (behind, carry[1] + gained), gain

    nothing = _Ahead(
        pose=jnp.zeros((3, 3), kind),
        cross=jnp.zeros((3, wide), kind),
        map=jnp.zeros((wide, wide), kind),
        pose_y=jnp.zeros(3, kind),
        map_y=jnp.zeros(wide, kind),
    )
    end = nothing, jnp.zeros((), kind)
    (ahead, decrement), gains = jax.lax.scan(back, end, chain.steps, reverse=True)
    ahead, first, gained = _without_noise(ahead, chain.start.root, chain.start.noise)
    decrement = decrement + gained
    landmarks, factor, regular = ahead.map_y, ahead.map, jnp.asarray(True)
    if wide > 0:
        dead = jnp.repeat(~alive, size).astype(kind)
        factor, regular = linalg.cholesky(linalg.symmetrize(ahead.map) + jnp.diag(dead))
        half = linalg.solve_lower(factor, ahead.map_y)
        landmarks = _solve_upper(factor, half)
        decrement = decrement + (half**2).sum()
    return Policy(first, gains, landmarks.reshape(capacity, size), factor, decrement, regular)


def _measured(ahead: _Ahead, step: Step, capacity: int) -> _Ahead:
    """Λ + (A B)ᵀ (A B) and y + (A B)ᵀ b over the places of a scan, where they touch Λ."""
    a, b, r = step.pose_rows, step.landmark_rows, step.residual
    size = b.shape[2]

    def by_slot(each: Array) -> Array:
        """(M, …) added up by the slots seen, (N, …)."""
        return jnp.zeros((capacity, *each.shape[1:]), r.dtype).at[step.slot].add(each)

    cross = by_slot(jnp.einsum("mzi,mzl->mil", a, b)).transpose(1, 0, 2).reshape(3, -1)
    rows = jnp.arange(capacity)[:, None] * size + jnp.arange(size)[None, :]
    own = by_slot(jnp.einsum("mzk,mzl->mkl", b, b))
    return _Ahead(
        pose=ahead.pose + jnp.einsum("mzi,mzj->ij", a, a),
        cross=ahead.cross + cross,
        map=ahead.map.at[rows[:, :, None], rows[:, None, :]].add(own),
        pose_y=ahead.pose_y + jnp.einsum("mzi,mz->i", a, r),
        map_y=ahead.map_y + by_slot(jnp.einsum("mzl,mz->ml", b, r)).reshape(-1),
    )


def _without_noise(ahead: _Ahead, by_noise: Array, noise: Array) -> tuple[_Ahead, Gain, Array]:
    """The least over d where the deviation is a + G d; its gain, and its part of λ²."""
    seen = linalg.gram(by_noise, ahead.pose)
    square = linalg.symmetrize(seen @ by_noise)
    factor, _ = linalg.cholesky(square + jnp.eye(noise.shape[0], dtype=noise.dtype))
    pull = linalg.solve_lower(factor, by_noise.T @ ahead.pose_y - noise)
    by_pose = linalg.solve_lower(factor, seen)
    by_map = linalg.solve_lower(factor, linalg.gram(by_noise, ahead.cross))
    left = _Ahead(
        pose=ahead.pose - linalg.gram(by_pose, by_pose),
        cross=ahead.cross - linalg.gram(by_pose, by_map),
        map=ahead.map - linalg.gram(by_map, by_map),
        pose_y=ahead.pose_y - pull @ by_pose,
        map_y=ahead.map_y - pull @ by_map,
    )
    constant, by_pose, by_map = (_solve_upper(factor, part) for part in (pull, by_pose, by_map))
    return left, Gain(constant, by_pose, by_map, factor), (pull**2).sum()


def _solve_upper(factor: Array, rhs: Array) -> Array:
    """L⁻ᵀ B of lower L."""
    return linalg.solve_lower(factor[::-1, ::-1].T, rhs[::-1])[::-1]
