"""A ring of poses, and its optimum by a dense Gauss-Newton: plain NumPy, from the equations."""

import numpy as np
from reference.plane import between, compose, wrap

from jaxslam.graphs import Graph, Table

SIZE = 20


def ring(seed=0, spread=1.0):
    """A ring of 20 poses with 4 chords, the first pose fixed, started along its edges."""
    rng = np.random.default_rng(seed)
    turn = 2 * np.pi * np.arange(SIZE) / SIZE
    truth = np.stack([10 * np.cos(turn), 10 * np.sin(turn), wrap(turn + np.pi / 2)], -1)
    first = np.r_[np.arange(SIZE), [0, 3, 5, 17]]
    second = np.r_[(np.arange(SIZE) + 1) % SIZE, [10, 14, 18, 8]]
    root = rng.normal(size=(len(first), 3, 3)) + 4 * np.eye(3)
    information = 40 * root @ np.swapaxes(root, 1, 2)
    noise = np.linalg.solve(
        np.linalg.cholesky(information).transpose(0, 2, 1), rng.normal(size=(len(first), 3, 1))
    )
    z = compose(between(truth[first], truth[second]), spread * noise[..., 0])
    poses = [truth[0]]
    for row in z[: SIZE - 1]:
        poses.append(compose(poses[-1], row))
    fixed = np.arange(SIZE) == 0
    table = Table(
        np.stack([first, second], 1).astype(np.int32), z, information, np.ones(len(first), bool)
    )
    return Graph(
        np.array(poses),
        np.zeros((0, 2)),
        {"relative_pose": table},
        fixed,
        np.zeros(0, bool),
        np.arange(SIZE),
        np.zeros(0, int),
    )


def dense(graph, steps=15):
    """(poses, χ², H, g) by Gauss-Newton on dense matrices; H, g by (x, y, θ) of the free poses."""
    table, poses = graph.tables["relative_pose"], np.array(graph.poses)
    i, j = np.asarray(table.who).T
    for step in range(steps + 1):
        e, row = between(table.z, between(poses[i], poses[j])), np.arange(len(i))
        c, s = np.cos(poses[i, 2] + table.z[:, 2]), np.sin(poses[i, 2] + table.z[:, 2])
        dx, dy = (poses[j] - poses[i])[:, :2].T
        jacobian = np.zeros((len(i), 3, len(poses), 3))
        for r, by_second in enumerate(([c, s, 0 * c], [-s, c, 0 * c], [0 * c, 0 * c, 1 + 0 * c])):
            for k, slope in enumerate(by_second):
                jacobian[row, r, j, k] += slope
                jacobian[row, r, i, k] -= slope
        jacobian[row, 0, i, 2] += c * dy - s * dx
        jacobian[row, 1, i, 2] -= c * dx + s * dy
        jacobian = jacobian[:, :, 1:].reshape(len(i), 3, -1)
        hessian = np.einsum("era,ers,esb->ab", jacobian, table.information, jacobian)
        gradient = np.einsum("era,ers,es->a", jacobian, table.information, e)
        if step < steps:
            poses[1:] -= np.linalg.solve(hessian, gradient).reshape(-1, 3)
    return poses, np.einsum("er,ers,es->", e, table.information, e), hessian, gradient
