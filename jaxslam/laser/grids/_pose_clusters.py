"""The hypotheses among weighted poses: groups of bins that touch."""

import itertools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy  # its parts load where they are used
from jax import Array
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from jaxslam.core.validation import InvalidField, refusals_of
from jaxslam.filters._particles.pose_particles import weighted_pose_moments


class Clusters(NamedTuple):
    """K groups of particles, the heaviest first, each a hypothesis on the pose."""

    weight: Float[np.ndarray, "K"]
    """Σ w of a group; the sum is 1 less the groups that `least` left out"""
    mean: Float[np.ndarray, "K 3"]
    cov: Float[np.ndarray, "K 3 3"]
    size: Int[np.ndarray, "K"]
    """particles of positive weight"""
    label: Int[np.ndarray, "P"]
    """group of each particle, -1 without"""


def clusters(
    pose: ArrayLike,
    log_weight: ArrayLike,
    *,
    bins: tuple[float, float, float] = (0.5, 0.5, math.radians(15)),
    least: float = 0.0,
) -> Clusters:
    """The hypotheses of weighted poses: particles in bins (x, y, θ) that touch, also by a corner.

    Headings are on a circle. Mean and covariance of a group are those of `moments.
    weighted_pose_moments` with its weights. On the host.

    Args:
        pose: (P, 3). log_weight: (P,) of any scale, -inf where not in use.
        bins: sizes in x [m], y [m], θ [rad]; a whole turn has the largest whole number of bins that
            are at least that size.
        least: groups of less weight are left out.
    Raises:
        ValueError: shapes, bins not above 0, or no particle of positive weight.
    """
    poses, weights = np.asarray(pose, np.float64), np.asarray(log_weight, np.float64)
    with refusals_of("clusters"):
        if poses.ndim != 2 or poses.shape[1] != 3 or weights.shape != poses.shape[:1]:
            raise InvalidField(
                "pose",
                f"expected poses (P, 3) and weights (P,), got {poses.shape}, {weights.shape}",
            )
        if np.shape(bins) != (3,) or not all(np.isfinite(b) and b > 0 for b in bins):
            raise InvalidField("bins", f"expected three sizes above 0, got {bins!r}")
        used = np.flatnonzero(np.isfinite(weights) & np.isfinite(poses).all(axis=1))
        if len(used) == 0:
            raise InvalidField("", "no particle has a finite pose and a positive weight")
    # Relative to the largest: weights of any scale, without underflow of all.
    w = np.exp(weights[used] - weights[used].max())
    w = w / w.sum()
    # 1e-9: a bin that divides the turn must not lose one to rounding.
    turns = max(int(2 * math.pi / bins[2] + 1e-9), 1)
    # The last `% turns` is for a share that is rounded up to 1.
    heading = np.floor((poses[used, 2] / (2 * math.pi) % 1.0) * turns) % turns
    at = np.column_stack([np.floor(poses[used, :2] / bins[:2]), heading]).astype(np.int64)
    cells, cell = np.unique(at, axis=0, return_inverse=True)
    group = _connect(cells, turns)[cell.reshape(-1)]
    total = np.bincount(group, weights=w)
    order = np.argsort(-total, kind="stable")
    order = order[total[order] >= least]
    rank = np.full(len(total), -1)
    rank[order] = np.arange(len(order))
    label = np.full(len(poses), -1)
    label[used] = rank[group]
    # A weight of 0 times NaN would be NaN.
    safe = np.where(np.isfinite(poses), poses, 0.0)
    moments = [_moments(safe, weights, label == k) for k in range(len(order))]
    mean = np.array([np.asarray(m) for m, _ in moments]).reshape(-1, 3)
    cov = np.array([np.asarray(c) for _, c in moments]).reshape(-1, 3, 3)
    return Clusters(total[order], mean, cov, np.bincount(group)[order], label)


@jax.jit
def _moments(pose: Array, log_weight: Array, mine: Array) -> tuple[Array, Array]:
    """The mean and covariance of the particles of a mask."""
    log_w = jnp.where(mine, log_weight, -jnp.inf)
    top = log_w.max()
    log_w = log_w - (top + jnp.log(jnp.exp(log_w - top).sum()))
    return weighted_pose_moments(pose, log_w, jnp.argmax(log_w))


def _connect(cells: Int[np.ndarray, "C 3"], turns: int) -> Int[np.ndarray, "C"]:
    """The group of each of C different bins.

    Two bins are neighbours if no index differs by more than 1; the third index is on a circle.
    """
    index = {tuple(cell): k for k, cell in enumerate(cells.tolist())}
    pairs = [
        (k, near)
        for (x, y, h), k in index.items()
        for i, j, t in itertools.product((-1, 0, 1), repeat=3)
        if (near := index.get((x + i, y + j, (h + t) % turns))) is not None
    ]
    rows, columns = np.array(pairs).T
    table = scipy.sparse.coo_array(
        (np.ones(len(pairs), bool), (rows, columns)), shape=(len(cells), len(cells))
    )
    group: np.ndarray = scipy.sparse.csgraph.connected_components(table, directed=False)[1]
    return group
