"""The means and covariances of the poses of a solved chain, by a forward recursion."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.graphs.chain.elimination import Chain, Gain, LinearizedStep, Policy
from jaxslam.math import linalg


class ChainMarginals(NamedTuple):
    """The marginals of the Gaussian of a chain: of each pose, and of the last pose with the map."""

    path: Float[Array, "T+1 3"]
    """δx, from the start on"""
    covs: Float[Array, "T+1 3 3"]
    cov: Float[Array, "D D"]
    """of the last pose and the map, D = 3 + NL; unit variance at dead slots"""


def chain_marginals(chain: Chain, policy: Policy) -> ChainMarginals:
    """The marginals of a chain, in O(T N) plus one triangular system of 3T columns.

    With n standard normal and M = R Rᵀ the matrix of the gain,

        δx_t = (I - G J)(F δx_{t-1} + c) + G (k - K δm + R⁻ᵀ n):

    for a given map δx_t has covariance S_t and depends on the map by T_t δm. Its covariance is
    S_t + T_t Σ T_tᵀ, where Σ is that of the map.
    """
    delta = policy.landmarks.reshape(-1)
    wide = delta.shape[0]

    def own_cov(by_noise: Array, gain: Gain) -> Array:
        spread = linalg.solve_lower(gain.factor, by_noise.T)
        return linalg.gram(spread, spread)

    def forward(
        before: tuple[Array, Array, Array], row: tuple[LinearizedStep, Gain]
    ) -> tuple[tuple[Array, Array, Array], tuple[Array, Array, Array]]:
        deviation, own, by_map = before
        step, gain = row
        ahead = step.by_pose @ deviation + step.drift
        noise = gain.constant - gain.by_pose @ ahead - gain.by_map @ delta
        closed = step.by_pose - step.by_noise @ (gain.by_pose @ step.by_pose)
        after = (
            ahead + step.by_noise @ noise,
            linalg.symmetrize(closed @ own @ closed.T + own_cov(step.by_noise, gain)),
            linalg.matmul(closed, by_map) - linalg.matmul(step.by_noise, gain.by_map),
        )
        return after, after

    root, gain = chain.start.root, policy.start
    start = (
        root @ (gain.constant - gain.by_map @ delta),
        own_cov(root, gain),
        -linalg.matmul(root, gain.by_map),
    )
    _, rest = jax.lax.scan(forward, start, (chain.steps, policy.steps))
    path, own, by_map = (
        jnp.concatenate([one[None], more]) for one, more in zip(start, rest, strict=True)
    )
    if wide == 0:
        return ChainMarginals(path, own, own[-1])
    poses = path.shape[0]
    spread = linalg.solve_lower(policy.map_factor, by_map.reshape(poses * 3, wide).T)
    spread = spread.reshape(wide, poses, 3)
    covs = own + jnp.einsum("nti,ntj->tij", spread, spread)
    unit = linalg.solve_lower(policy.map_factor, jnp.eye(wide, dtype=own.dtype))
    of_map = unit.T @ unit
    cross = by_map[-1] @ of_map
    cov = jnp.block([[covs[-1], cross], [cross.T, of_map]])
    return ChainMarginals(path, covs, cov)
