"""Covariances of relative poses, on the host, all of the end of the pose.

The end of z has the covariance of the small pose e with true z = z ∘ e, whose x and y are in the
frame of the second pose: the residual of the graph's relative poses.
"""

import numpy as np
from jaxtyping import Float

from jaxslam.math.numpy_poses import Poses, adjoint, inverse

_Covs = Float[np.ndarray, "... 3 3"]


def propagate(by: Float[np.ndarray, "... 3 k"], cov: Float[np.ndarray, "... k k"]) -> _Covs:
    """The covariance J Σ Jᵀ of J e, with Σ the covariance of e."""
    return np.asarray(by @ cov @ np.swapaxes(by, -1, -2))


def move(cov: _Covs, by: Poses) -> _Covs:
    """The covariance of the end of z ∘ by, with `cov` of the end of z and `by` certain."""
    ad = adjoint(inverse(by))
    return propagate(ad, cov)


def composed_cov(cov: _Covs, step: Poses, step_cov: _Covs) -> _Covs:
    """The covariance of the end of z ∘ step, both uncertain and independent."""
    return np.asarray(move(cov, step) + step_cov)


def at_end(cov: _Covs, z: Poses) -> _Covs:
    """The covariance of the end of z from that of its coordinates (x, y, θ)."""
    turn = turns(-z[..., 2])
    return propagate(turn, cov)


def of_coordinates(cov: _Covs, z: Poses) -> _Covs:
    """The covariance of the coordinates (x, y, θ) of z from that of its end."""
    turn = turns(z[..., 2])
    return propagate(turn, cov)


def along(poses: Float[np.ndarray, "N 3"], covs: Float[np.ndarray, "m 3 3"]) -> _Covs:
    """(N, 3, 3) sums S of the covariances of the steps of a chain, all in the world's frame.

    The covariance of the end of the pose j relative to the pose i ≤ j is, to first order,
    Ad(x_j)⁻¹ (S_j - S_i) Ad(x_j)⁻ᵀ (`relative_cov`).
    """
    ad = adjoint(poses[1:])
    total = np.zeros((len(poses), 3, 3))
    np.cumsum(propagate(ad, covs), axis=0, out=total[1:])
    return total


def relative_cov(total: _Covs, poses: Poses, i: np.ndarray, j: np.ndarray) -> _Covs:
    """The covariance of the end of pose j relative to pose i along a chain, in either order."""
    difference = total[np.maximum(i, j)] - total[np.minimum(i, j)]
    ad = adjoint(inverse(poses[j]))
    return propagate(ad, difference)


def semidefinite(information: _Covs) -> _Covs:
    """The symmetric matrix without its negative eigenvalues.

    The information of walls may have negative ones: the information that noise feigns is subtracted
    from it (`information_along`), which can be too much.
    """
    values, vectors = np.linalg.eigh(np.asarray(information, np.float64))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ np.swapaxes(vectors, -1, -2))


def turns(angle: Float[np.ndarray, "..."]) -> _Covs:
    """R(angle) for x and y, 1 for θ."""
    c, s = np.cos(angle), np.sin(angle)
    zero, unit = np.zeros_like(c), np.ones_like(c)
    rows = [[c, -s, zero], [s, c, zero], [zero, zero, unit]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
