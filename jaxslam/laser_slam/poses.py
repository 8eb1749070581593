"""Poses of the plane on the host: many at once, with NumPy.

Relative poses have covariances *of the end*: of the small pose e with true = estimated ∘ e, whose x
and y are in the frame of the second pose. That is the residual of the graph's relative poses.
"""

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

Poses = Float[np.ndarray, "... 3"]
Covs = Float[np.ndarray, "... 3 3"]


def wrapped(angle: ArrayLike) -> Float[np.ndarray, "..."]:
    """Angles in (-π, π]."""
    turned = np.asarray(angle, np.float64)
    return np.asarray(np.pi - np.mod(np.pi - turned, 2 * np.pi))


def compose(a: Poses, b: Poses) -> Poses:
    """a ∘ b, leading axes broadcast."""
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + c * b[..., 0] - s * b[..., 1]
    y = a[..., 1] + s * b[..., 0] + c * b[..., 1]
    return np.stack([x, y, wrapped(a[..., 2] + b[..., 2])], axis=-1)


def inverse(a: Poses) -> Poses:
    """a⁻¹."""
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x, y = -c * a[..., 0] - s * a[..., 1], s * a[..., 0] - c * a[..., 1]
    return np.stack([x, y, wrapped(-a[..., 2])], axis=-1)


def between(a: Poses, b: Poses) -> Poses:
    """a⁻¹ ∘ b: b in the frame of a."""
    return compose(inverse(a), b)


def chain(first: Poses, steps: Poses) -> Poses:
    """(T + 1, 3): the first pose, and those that T relative poses lead to one after the other."""
    out = np.empty((len(steps) + 1, 3))
    out[0] = first
    for t, step in enumerate(steps):
        out[t + 1] = compose(out[t], step)
    return out


def adjoint(pose: Poses) -> Covs:
    """Ad with pose ∘ e = (Ad e) ∘ pose to first order in a small pose e."""
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    zero, one = np.zeros_like(c), np.ones_like(c)
    rows = [[c, -s, pose[..., 1]], [s, c, -pose[..., 0]], [zero, zero, one]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def carried(by: Float[np.ndarray, "... 3 k"], cov: Float[np.ndarray, "... k k"]) -> Covs:
    """J Σ Jᵀ."""
    return np.asarray(by @ cov @ np.swapaxes(by, -1, -2))


def moved(cov: Covs, by: Poses) -> Covs:
    """The covariance of the end of z ∘ by, where by is certain and that of the end of z is cov."""
    ad = adjoint(inverse(by))
    return carried(ad, cov)


def composed_cov(cov: Covs, step: Poses, step_cov: Covs) -> Covs:
    """The covariance of the end of z ∘ step, both uncertain and independent."""
    return np.asarray(moved(cov, step) + step_cov)


def at_end(cov: Covs, z: Poses) -> Covs:
    """The covariance of the end of z from that of its coordinates (x, y, θ)."""
    turn = turns(-z[..., 2])
    return carried(turn, cov)


def of_coordinates(cov: Covs, z: Poses) -> Covs:
    """The covariance of the coordinates (x, y, θ) of z from that of its end."""
    turn = turns(z[..., 2])
    return carried(turn, cov)


def along(poses: Float[np.ndarray, "N 3"], covs: Float[np.ndarray, "m 3 3"]) -> Covs:
    """(N, 3, 3) sums S of the covariances of the steps of a chain, all in the world's frame.

    The covariance of the end of the pose j relative to the pose i ≤ j is, to first order,
    Ad(x_j)⁻¹ (S_j - S_i) Ad(x_j)⁻ᵀ (`relative_cov`).
    """
    ad = adjoint(poses[1:])
    total = np.zeros((len(poses), 3, 3))
    np.cumsum(carried(ad, covs), axis=0, out=total[1:])
    return total


def relative_cov(total: Covs, poses: Poses, i: np.ndarray, j: np.ndarray) -> Covs:
    """The covariance of the end of pose j relative to pose i along a chain, in either order."""
    difference = total[np.maximum(i, j)] - total[np.minimum(i, j)]
    ad = adjoint(inverse(poses[j]))
    return carried(ad, difference)


def semidefinite(information: Covs) -> Covs:
    """The symmetric matrix without its negative eigenvalues.

    Of the information of walls what their noise feigns is subtracted, which can be too much.
    """
    values, vectors = np.linalg.eigh(np.asarray(information, np.float64))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ np.swapaxes(vectors, -1, -2))


def turns(angle: Float[np.ndarray, "..."]) -> Covs:
    """R(angle) for x and y, 1 for θ."""
    c, s = np.cos(angle), np.sin(angle)
    zero, one = np.zeros_like(c), np.ones_like(c)
    rows = [[c, -s, zero], [s, c, zero], [zero, zero, one]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
