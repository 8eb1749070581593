"""What a film shows of a filter's own state, particles, links or hypotheses, and its layers."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxslam.core.types import Estimate
from jaxslam.filters.delayed.state import DelayedState, covariance_blocks
from jaxslam.filters.information.eif_slam import CanonicalState
from jaxslam.filters.information.marginals import local_information
from jaxslam.filters.information.sparse_state import SparseState
from jaxslam.filters.particles.pose_particles import PoseParticles
from jaxslam.filters.particles.slam_particles import SlamParticles
from jaxslam.results.plot.scene.film import Layer
from jaxslam.results.plot.scene.layers import cloud, lines_between, marks, rings, weighted_segments
from jaxslam.results.plot.style import COLORS, INK, Look

_ROBOT_LINK, _LINK = COLORS[5], COLORS[3]

_CUT_FOR = 8
"""number of frames in which a link that was cut is still shown"""

_SEEN = 0.2
"""A link to the robot is drawn as if it were at least so strong."""

_WEAK = 1e-9
"""strength of a link that is rounding alone"""


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


def particle_layer(seen: Cloud, origin: np.ndarray, label: str) -> Layer:
    """The layer of the positions of particles, from an origin (F, 2)."""
    look: Look = {"color": COLORS[7], "lw": 0, "alpha": 0.6, "zorder": 5.1}
    at = np.asarray(seen.pose)[..., :2] - origin[:, None]
    return cloud(at, np.asarray(seen.weight), label=label, **look)


def hypothesis_layers(seen: object) -> list[Layer]:
    """The layers of points that may become landmarks; none where `seen` is not `Hypotheses`."""
    if not isinstance(seen, Hypotheses):
        return []
    points, covs, persistence = map(np.asarray, seen)
    shown = persistence > 0
    ring: Look = {"color": COLORS[3], "lw": 0.9, "ls": (0, (2, 1.2)), "zorder": 3.8}
    dots: Look = {"color": COLORS[3], "marker": "D", "mfc": "white", "ms": 3.5, "zorder": 3.9}
    return [
        rings(points, covs, shown, label="hypothesis, 3 σ", **ring),
        marks(points, shown, label="_", **dots),
    ]


def link_layers(seen: object, estimate: Estimate) -> list[Layer]:
    """The layers of the links of an information matrix, as wide as strong; lately cut ones dotted.

    None where `seen` is not `Links`. estimate: with leading F, as the links.
    """
    if not isinstance(seen, Links):
        return []
    strength = np.asarray(seen.strength)
    strength = np.where(np.isfinite(strength) & (strength > _WEAK), strength, 0.0)
    between: list[np.ndarray] = []
    robot: list[np.ndarray] = []
    cut: list[np.ndarray] = []
    weights: dict[str, list[np.ndarray]] = {"between": [], "robot": []}
    for k, step in enumerate(strength):
        nodes = np.concatenate([estimate.pose[k, None, :2], estimate.points[k]])
        there = np.triu(step > 0)
        lately = np.triu(strength[max(0, k - _CUT_FOR) : k + 1].max(axis=0) > 0)
        i, j = np.nonzero(there)
        ends, weight = nodes[np.stack([i, j], axis=1)], np.minimum(step[i, j], 1.0)
        between.append(ends[i > 0])
        robot.append(ends[i == 0])
        weights["between"].append(weight[i > 0])
        weights["robot"].append(np.maximum(weight[i == 0], _SEEN))
        alive = np.append(True, estimate.alive[k])
        gone = lately & ~there & alive[:, None] & alive[None, :]
        cut.append(nodes[np.stack(np.nonzero(gone), axis=1)])
    look: Look = {"capstyle": "round", "zorder": 2.6}
    dots: Look = {"color": INK, "lw": 1.0, "ls": (0, (1, 1.2)), "zorder": 2.8}
    landmarks: Look = look | {"width": 3.0, "label": "link of landmarks"}
    robots: Look = look | {"width": 5.0, "label": "link to the robot"}
    return [
        weighted_segments(between, weights["between"], color=_LINK, **landmarks),
        weighted_segments(robot, weights["robot"], color=_ROBOT_LINK, **robots),
        *([lines_between(cut, label="link cut", **dots)] if any(map(len, cut)) else []),
    ]
