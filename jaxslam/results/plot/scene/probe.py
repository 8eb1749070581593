"""What a film shows of a filter's own state: particles, links, or hypotheses."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxslam.filters.delayed.state import DelayedState, covariance_blocks
from jaxslam.filters.information.eif_slam import CanonicalState
from jaxslam.filters.information.marginals import local_information
from jaxslam.filters.information.sparse_state import SparseState
from jaxslam.filters.particles.pose_particles import PoseParticles
from jaxslam.filters.particles.slam_particles import SlamParticles


class Cloud(NamedTuple):
    """Particles, with leading T in a trace."""

    pose: Float[Array, "*T P 3"]
    weight: Float[Array, "*T P"]
    """Σ = 1, 0 where not in use"""


class Links(NamedTuple):
    """Links of the robot (row 0) and the landmarks (row 1 + slot), with leading T in a trace."""

    strength: Float[Array, "*T K K"]
    """‖Ω_ij‖ / √(‖Ω_ii‖ ‖Ω_jj‖) of the blocks of positions, at most 1; 0 without link"""


class Hypotheses(NamedTuple):
    """Points where stored measurements intersect, with leading T in a trace."""

    points: Float[Array, "*T C 2"]
    covs: Float[Array, "*T C 2 2"]
    persistence: Float[Array, "*T C"]
    """0 where not in use"""


def probe(state: PyTree) -> Cloud | Links | Hypotheses | None:
    """What `animate` shows of the state of a particle filter, information filter or `DelayedSlam`.

        trace = jaxslam.run(filter, log, pose, pose_cov, key, probe=jaxslam.plot.probe)

    None of other filters, whose films need no probe; `mapping`, of one particle, is among them.
    """
    if isinstance(state, SlamParticles | PoseParticles) and state.log_weight.ndim:
        return Cloud(state.pose, jnp.exp(state.log_weight))
    if isinstance(state, SparseState):
        every = jnp.arange(state.alive.shape[0], dtype=jnp.int32)
        return _links(local_information(state, every), 2)
    if isinstance(state, CanonicalState):
        return _links(state.omega, state.landmarks.shape[1])
    if isinstance(state, DelayedState):
        return _hypotheses(state)
    return None


def _hypotheses(state: DelayedState) -> Hypotheses:
    """The hypotheses of a state, whose slots follow those of the landmarks."""
    joint, count = state.joint, state.persistence.shape[0]
    first = joint.alive.shape[0] - state.taken_at.shape[0] - count
    slot = first + np.arange(count)
    covs = covariance_blocks(joint)[slot, :2, slot, :2]
    persistence = jnp.where(joint.alive[slot], state.persistence, 0.0)
    return Hypotheses(joint.landmarks[slot, :2], covs, persistence)


def _links(omega: Float[Array, "D D"], size: int) -> Links:
    """The links of Ω of a robot and landmarks of `size` parameters."""
    # NumPy's arrays are constants, and cost no operation.
    landmarks = 3 + np.arange((omega.shape[0] - 3) // size)[:, None] * size + np.arange(2)
    rows = np.concatenate([np.arange(2)[None], landmarks])
    blocks = omega[rows[:, None, :, None], rows[None, :, None, :]]
    norm = jnp.sqrt((blocks**2).sum(axis=(2, 3)))
    own = jnp.sqrt(jnp.diagonal(norm))
    apart = ~np.eye(len(rows), dtype=bool)
    return Links(jnp.where(apart, norm / (own[:, None] * own[None, :]), 0.0).astype(jnp.float32))
