"""Dense NumPy counterparts of what the sparse information filters hold and do, for their tests."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.filters.information.marginals import local_information

COUNT = 36
"""landmarks of the cloister"""

dense = jax.jit(lambda state: local_information(state, jnp.arange(state.alive.shape[0])))


def canonical(state):
    """Ω, ξ and μ of all."""
    omega, state = np.array(dense(state)), jax.device_get(state)
    mean = np.concatenate([state.pose, np.ravel(state.landmarks)])
    residual = np.concatenate([state.pose_residual, np.ravel(state.landmark_residual)])
    return omega, omega @ mean + residual, mean


def at(slots, robot=True):
    """Rows of robot and landmarks in Ω."""
    rows = ([0, 1, 2] if robot else []) + [3 + 2 * s + k for s in slots for k in (0, 1)]
    return np.array(rows, int)


def picks(slots, robot=False):
    """F, (D, n): the columns of the unit matrix of robot and landmarks."""
    return np.eye(3 + 2 * COUNT)[:, at(slots, robot)]


def h_of(pose, point, slot):
    """(2, D) of range and bearing, and what is expected."""
    dx, dy = point - pose[:2]
    q = dx * dx + dy * dy
    r = np.sqrt(q)
    h = np.zeros((2, 3 + 2 * COUNT))
    h[:, at([slot])] = [
        [-dx / r, -dy / r, 0, dx / r, dy / r],
        [dy / q, -dx / q, -1, -dy / q, dx / q],
    ]
    return h, np.array([r, np.arctan2(dy, dx) - pose[2]])


def measured(omega, xi, mean, scan, i, noise):
    """Ω and ξ after measurement i of a scan, the models at a mean; and its H."""
    slot = int(scan.tag[i])
    h, expected = h_of(mean[:3], mean[at([slot], robot=False)], slot)
    nu = np.asarray(scan.z[i]) - expected
    nu[1] = np.angle(np.exp(1j * nu[1]))
    gain = h.T @ np.linalg.inv(noise)
    return omega + gain @ h, xi + gain @ (nu + h @ mean), h


def initialized(omega, xi, mean, slot, noise):
    """Ω and ξ after a landmark is new at the mean: H and its noise say the same as g and its own."""
    h, _ = h_of(mean[:3], mean[at([slot], robot=False)], slot)
    more = h.T @ np.linalg.inv(noise) @ h
    padding = picks([slot])
    return omega + more - padding @ padding.T, xi + more @ mean


def close(a, b, tolerance=1e-8):
    """The same to a share of the largest entry."""
    np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * np.abs(b).max())


def dtypes(tree):
    return {str(leaf.dtype) for leaf in jax.tree.leaves(tree)}
