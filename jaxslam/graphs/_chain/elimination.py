"""The linear-Gaussian problem of a path and a map, solved by a backward recursion.

Poses form a chain and landmarks are static, so the least-squares problem of T poses and N
landmarks needs no matrix larger than the map's. Backward, the information of later measurements on
(pose, map) is propagated from pose to pose, and the noise of each motion is eliminated: its optimum
is an affine function of the pose after the motion and of the map. The map remains at the start.
Forward, these functions give the path (`chain_marginals`). This is dynamic programming, and among
smoothers the one of backward information and forward means (Mayne 1966, "A solution of the
smoothing problem for linear dynamic systems", Automatica 4(2); Fraser & Potter 1969, IEEE TAC
14(4)).

No covariance of a motion, of the start or of a pose is inverted, so all may be singular; no prior
of a landmark is needed, so it does not matter when one is initialized; and covariances are
sums of squares. O(T N²) time, and O(T N) memory plus a few matrices of N². A pose has R numbers:
3, or 3 + E where the state of the motion has E further ones, none of which is an angle.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.core.protocols import Sensor
from jaxslam.linearize import _first_order as first_order
from jaxslam.math import _linalg as linalg
from jaxslam.math.angles import wrap

Rows = tuple[Array, Array, Array, Array]
"""A (Z, R), B (Z, L) and b (Z,) of a measurement, as in `LinearizedStep`, in units of its
noise; and () bool, whether the covariance of that noise is positive definite."""


def whitened_rows(
    sensor: Sensor,
    z: Float[Array, "Z"],
    pose: Float[Array, "R"],
    landmark: Float[Array, "L"],
    used: Bool[Array, ""],
    at_landmark: Float[Array, "L"] | None = None,
) -> Rows:
    """The rows of a measurement: R(ẑ)^{-1/2} times H_pose, H_l and z ⊖ ẑ.

    used: whether the measurement is of this landmark. at_landmark: where H is taken, if elsewhere.
    """
    at_landmark = landmark if at_landmark is None else at_landmark
    by_pose, by_landmark = first_order.observe_jacobians(sensor, pose, at_landmark)
    z_hat = sensor.observe(pose, landmark)
    noise = first_order.predicted_noise(sensor, z_hat, z, used)
    factor, positive = linalg.cholesky(noise)
    parts = by_pose, by_landmark, sensor.residual(z, z_hat)
    a, b, r = (linalg.solve_lower(factor, part) for part in parts)
    return a, b, r, positive


def pose_difference(a: Float[Array, "R"], b: Float[Array, "R"]) -> Float[Array, "R"]:
    """The difference a - b of two poses by coordinates, with the angle wrapped."""
    difference = a - b
    return difference.at[2].set(wrap(difference[2]))


class Start(NamedTuple):
    """The initial pose δx_0 = L d_0, at a cost of ½ |ξ̄ + d_0|²."""

    root: Float[Array, "R R"]
    """L, with L Lᵀ the covariance of the start"""
    noise: Float[Array, "R"]
    """ξ̄"""


class LinearizedStep(NamedTuple):
    """A motion and the scan after it, as deviations δ from a reference path x̄ and map m̄.

        δx_t = F δx_{t-1} + c + G d_t    ½ |η̄ + d_t|²
        b = A δx_t + B δl_slot + e       ½ |e|²

    Noises, and e, b, A and B, are in units of standard deviations: the roots of the motions' noise
    covariances are factors of G. Rows of zeros have no effect. M measurement slots, Z rows each.
    """

    by_pose: Float[Array, "R R"]
    """F"""
    by_noise: Float[Array, "R W"]
    """G"""
    drift: Float[Array, "R"]
    """c: the pose after the motion from the reference, minus the next reference"""
    noise: Float[Array, "W"]
    """η̄"""
    slot: Int[Array, "M"]
    """slot of the landmark measured; any number where the rows are zeros"""
    pose_rows: Float[Array, "M Z R"]
    """A"""
    landmark_rows: Float[Array, "M Z L"]
    """B"""
    residual: Float[Array, "M Z"]
    """b"""


class Chain(NamedTuple):
    """The quadratic cost of a path and a map, the sum of the costs of its parts."""

    start: Start
    steps: LinearizedStep
    """with leading T"""


class Gain(NamedTuple):
    """The gain of the optimal noise d = k - J a - K δm, with a = F δx + c."""

    constant: Float[Array, "W"]
    """k"""
    by_pose: Float[Array, "W R"]
    """J"""
    by_map: Float[Array, "W NL"]
    """K"""
    factor: Float[Array, "W W"]
    """lower, of M = I + Gᵀ Λ G; M⁻¹ is the covariance of d for given a and δm"""


class Policy(NamedTuple):
    """The solution of a chain: the gains of all noises, and the map."""

    start: Gain
    """gain of d_0, where a = 0"""
    steps: Gain
    """gains of the motions' noises, with leading T"""
    landmarks: Float[Array, "N L"]
    """δm"""
    map_factor: Float[Array, "NL NL"]
    """lower Cholesky factor of the information on the map, 1 at dead slots"""
    decrement: Float[Array, ""]
    """λ²: where c = 0, twice the decrease from the reference's cost to the optimum, and the squared
    length of the step in posterior standard deviations (the Newton decrement)"""
    regular: Bool[Array, ""]
    """the information on the map is positive definite"""


class CostToGo(NamedTuple):
    """The cost to go ½ aᵀ Λ a - aᵀ y + constant, with a = (δpose, δmap)."""

    pose: Float[Array, "R R"]
    """block of Λ; so are the next two"""
    cross: Float[Array, "R NL"]
    map: Float[Array, "NL NL"]
    pose_y: Float[Array, "R"]
    """part of y; so is the next one"""
    map_y: Float[Array, "NL"]


def eliminate(chain: Chain, alive: Bool[Array, "N"]) -> Policy:
    """The solution of a chain. alive: the landmarks that are measured at all."""
    capacity, size = alive.shape[0], chain.steps.landmark_rows.shape[3]
    wide, kind = capacity * size, chain.steps.residual.dtype
    to_go, gains, decrement = eliminate_steps(chain.steps, capacity)
    to_go, first, gained = _eliminate_noise(to_go, chain.start.root, chain.start.noise)
    decrement = decrement + gained
    landmarks, factor, regular = to_go.map_y, to_go.map, jnp.asarray(True)
    if wide > 0:
        # Unit information at dead slots, whose y is zero: the factor is regular, and their δm zero.
        dead = jnp.repeat(~alive, size).astype(kind)
        factor, regular = linalg.cholesky(linalg.symmetrize(to_go.map) + jnp.diag(dead))
        half = linalg.solve_lower(factor, to_go.map_y)
        landmarks = _solve_upper(factor, half)
        decrement = decrement + (half**2).sum()
    return Policy(first, gains, landmarks.reshape(capacity, size), factor, decrement, regular)


def eliminate_steps(
    steps: LinearizedStep, capacity: int
) -> tuple[CostToGo, Gain, Float[Array, ""]]:
    """The cost of all steps as a function of the first pose and of the map, the gains of their
    noises, and their terms of λ².

    With Λ and y of all terms after motion t, its noise costs min over d of ½ |η̄ + d|² plus
    ½ (a + G d)ᵀ Λ (a + G d) - (a + G d)ᵀ y: at d = M⁻¹ (Gᵀ y - η̄ - Gᵀ Λ a), M = I + Gᵀ Λ G, which
    leaves Λ - Λ G M⁻¹ Gᵀ Λ and y - Λ G M⁻¹ (Gᵀ y - η̄); then a = F δx + c is substituted.
    """
    wide, kind = capacity * steps.landmark_rows.shape[3], steps.residual.dtype
    n = steps.by_pose.shape[-1]

    def back(
        carry: tuple[CostToGo, Array], step: LinearizedStep
    ) -> tuple[tuple[CostToGo, Array], Gain]:
        after, decrement = carry
        after = _add_measurements(after, step, capacity)
        after, gain, gained = _eliminate_noise(after, step.by_noise, step.noise)
        # As a function of the pose before the motion: a = F δx + c.
        before = CostToGo(
            pose=linalg.symmetrize(step.by_pose.T @ after.pose @ step.by_pose),
            cross=linalg.matmul(step.by_pose.T, after.cross),
            map=after.map,
            pose_y=step.by_pose.T @ (after.pose_y - after.pose @ step.drift),
            map_y=after.map_y - step.drift @ after.cross,
        )
        return (before, decrement + gained), gain

    no_cost = CostToGo(
        pose=jnp.zeros((n, n), kind),
        cross=jnp.zeros((n, wide), kind),
        map=jnp.zeros((wide, wide), kind),
        pose_y=jnp.zeros(n, kind),
        map_y=jnp.zeros(wide, kind),
    )
    end = no_cost, jnp.zeros((), kind)
    (to_go, decrement), gains = jax.lax.scan(back, end, steps, reverse=True)
    return to_go, gains, decrement


def _add_measurements(to_go: CostToGo, step: LinearizedStep, capacity: int) -> CostToGo:
    """The cost to go plus a scan: Λ + (A B)ᵀ (A B) and y + (A B)ᵀ b, in the rows it involves."""
    a, b, r = step.pose_rows, step.landmark_rows, step.residual
    size = b.shape[2]

    def sum_by_slot(values: Array) -> Array:
        """Values (M, …) summed by the slots seen, (N, …)."""
        return jnp.zeros((capacity, *values.shape[1:]), r.dtype).at[step.slot].add(values)

    # AᵀB: (N, R, L) to (R, NL). BᵀB: a block (L, L) for each slot, at rows and columns of its own.
    cross = sum_by_slot(jnp.einsum("mzi,mzl->mil", a, b)).transpose(1, 0, 2).reshape(a.shape[2], -1)
    rows = jnp.arange(capacity)[:, None] * size + jnp.arange(size)[None, :]
    diagonal = sum_by_slot(jnp.einsum("mzk,mzl->mkl", b, b))
    return CostToGo(
        pose=to_go.pose + jnp.einsum("mzi,mzj->ij", a, a),
        cross=to_go.cross + cross,
        map=to_go.map.at[rows[:, :, None], rows[:, None, :]].add(diagonal),
        pose_y=to_go.pose_y + jnp.einsum("mzi,mz->i", a, r),
        map_y=to_go.map_y + sum_by_slot(jnp.einsum("mzl,mz->ml", b, r)).reshape(-1),
    )


def _eliminate_noise(
    to_go: CostToGo, by_noise: Float[Array, "R W"], noise: Float[Array, "W"]
) -> tuple[CostToGo, Gain, Float[Array, ""]]:
    """The cost to go at a + G d minimized over d; the gain of the best d, and its term of λ²."""
    g_lambda = linalg.gram(by_noise, to_go.pose)  # Gᵀ Λ
    square = linalg.symmetrize(g_lambda @ by_noise)
    factor, _ = linalg.cholesky(square + jnp.eye(noise.shape[0], dtype=noise.dtype))
    pull = linalg.solve_lower(factor, by_noise.T @ to_go.pose_y - noise)
    by_pose = linalg.solve_lower(factor, g_lambda)
    by_map = linalg.solve_lower(factor, linalg.gram(by_noise, to_go.cross))
    # Squares of L⁻¹ times a term, so that what is subtracted is symmetric.
    eliminated = CostToGo(
        pose=to_go.pose - linalg.gram(by_pose, by_pose),
        cross=to_go.cross - linalg.gram(by_pose, by_map),
        map=to_go.map - linalg.gram(by_map, by_map),
        pose_y=to_go.pose_y - pull @ by_pose,
        map_y=to_go.map_y - pull @ by_map,
    )
    constant, by_pose, by_map = (_solve_upper(factor, part) for part in (pull, by_pose, by_map))
    return eliminated, Gain(constant, by_pose, by_map, factor), (pull**2).sum()


def _solve_upper(factor: Array, rhs: Array) -> Array:
    """The solution L⁻ᵀ B of lower L."""
    return linalg.solve_lower(factor[::-1, ::-1].T, rhs[::-1])[::-1]


def chain_marginals(
    chain: Chain, policy: Policy
) -> tuple[Float[Array, "poses R"], Float[Array, "poses R R"], Float[Array, "D D"]]:
    """The marginals of a chain, in O(T N) plus one triangular system of R T columns.

    They are δx from the start on, the covariance of each pose, and the joint covariance of the last
    pose and the map, D = R + NL, with unit variance at dead slots.

    With n standard normal and M = R Rᵀ the matrix of the gain,

        δx_t = (I - G J)(F δx_{t-1} + c) + G (k - K δm + R⁻ᵀ n):

    for a given map δx_t has covariance S_t and depends on the map by T_t δm. Its covariance is
    S_t + T_t Σ T_tᵀ, where Σ is the covariance of the map.
    """
    delta = policy.landmarks.reshape(-1)
    wide = delta.shape[0]

    def noise_spread(by_noise: Array, gain: Gain) -> Array:
        """G M⁻¹ Gᵀ, the covariance of G R⁻ᵀ n."""
        spread = linalg.solve_lower(gain.factor, by_noise.T)
        return linalg.gram(spread, spread)

    def forward(
        before: tuple[Array, Array, Array], row: tuple[LinearizedStep, Gain]
    ) -> tuple[tuple[Array, Array, Array], tuple[Array, Array, Array]]:
        deviation, pose_cov, by_map = before
        step, gain = row
        ahead = step.by_pose @ deviation + step.drift
        noise = gain.constant - gain.by_pose @ ahead - gain.by_map @ delta
        closed = step.by_pose - step.by_noise @ (gain.by_pose @ step.by_pose)
        after = (
            ahead + step.by_noise @ noise,
            linalg.symmetrize(closed @ pose_cov @ closed.T + noise_spread(step.by_noise, gain)),
            linalg.matmul(closed, by_map) - linalg.matmul(step.by_noise, gain.by_map),
        )
        return after, after

    root, gain = chain.start.root, policy.start
    start = (
        root @ (gain.constant - gain.by_map @ delta),
        noise_spread(root, gain),
        -linalg.matmul(root, gain.by_map),
    )
    _, rest = jax.lax.scan(forward, start, (chain.steps, policy.steps))
    path, pose_covs, by_map = (
        jnp.concatenate([first[None], later]) for first, later in zip(start, rest, strict=True)
    )
    if wide == 0:
        return path, pose_covs, pose_covs[-1]
    # Σ = L⁻ᵀ L⁻¹ with the factor L of the map: T_t Σ T_tᵀ is the square of L⁻¹ T_tᵀ. All T_t
    # together are one right-hand side of R T columns.
    poses, n = path.shape
    spread = linalg.solve_lower(policy.map_factor, by_map.reshape(poses * n, wide).T)
    spread = spread.reshape(wide, poses, n)
    covs = pose_covs + jnp.einsum("nti,ntj->tij", spread, spread)
    unit = linalg.solve_lower(policy.map_factor, jnp.eye(wide, dtype=pose_covs.dtype))
    of_map = unit.T @ unit
    cross = by_map[-1] @ of_map
    cov = jnp.block([[covs[-1], cross], [cross.T, of_map]])
    return path, covs, cov
