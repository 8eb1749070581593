"""The optimum of small graphs, against a dense Gauss-Newton in NumPy."""

import jax
import numpy as np
import pytest

from jaxslam import graphs
from jaxslam.graphs import Ending, Graph, Table

SIZE = 20


def compose(a, b):
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + c * b[..., 0] - s * b[..., 1]
    y = a[..., 1] + s * b[..., 0] + c * b[..., 1]
    return np.stack([x, y, wrap(a[..., 2] + b[..., 2])], -1)


def between(a, b):
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    dx, dy = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    return np.stack([c * dx + s * dy, -s * dx + c * dy, wrap(b[..., 2] - a[..., 2])], -1)


def wrap(angle):
    return np.pi - (np.pi - angle) % (2 * np.pi)


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
        e = between(table.z, between(poses[i], poses[j]))
        jacobian = np.zeros((len(i), 3, len(poses), 3))
        for k in range(len(i)):
            h = 1e-6
            for who in (i[k], j[k]):
                for c in range(3):
                    low, high = poses.copy(), poses.copy()
                    low[who, c] -= h
                    high[who, c] += h
                    up = between(table.z[k], between(high[i[k]], high[j[k]]))
                    down = between(table.z[k], between(low[i[k]], low[j[k]]))
                    slope = up - down
                    slope[2] = wrap(slope[2])
                    jacobian[k, :, who, c] = slope / (2 * h)
        jacobian = jacobian[:, :, 1:].reshape(len(i), 3, -1)
        hessian = np.einsum("era,ers,esb->ab", jacobian, table.information, jacobian)
        gradient = np.einsum("era,ers,es->a", jacobian, table.information, e)
        if step < steps:
            poses[1:] -= np.linalg.solve(hessian, gradient).reshape(-1, 3)
    return poses, np.einsum("er,ers,es->", e, table.information, e), hessian, gradient


@pytest.mark.parametrize("method", ["levenberg_marquardt", "gauss_newton", "dogleg"])
def test_the_optimum_is_that_of_dense_gauss_newton(method):
    graph = ring()
    poses, chi2, _, _ = dense(graph)
    found = graphs.optimize(graph, method=method)
    assert found.status == Ending.CONVERGED
    np.testing.assert_allclose(found.chi2, chi2, rtol=1e-10)
    np.testing.assert_allclose(found.graph.poses[:, :2], poses[:, :2], atol=1e-6)
    np.testing.assert_allclose(wrap(found.graph.poses[:, 2] - poses[:, 2]), 0, atol=1e-7)
    np.testing.assert_allclose(graphs.chi2(found.graph), chi2, rtol=1e-10)
    assert found.gradient < 1e-6 * found.gradient_start
    assert found.singular == -1


def test_marginals_are_the_blocks_of_the_dense_inverse():
    graph = ring()
    pairs = [[3, 4], [9, 2], [7, 19]]  # along an edge, none, none and turned round
    poses, _, information, _ = dense(graph)
    found = graphs.marginals(graph._replace(poses=poses), pairs=pairs)
    cov = np.zeros((SIZE, 3, SIZE, 3))
    cov[1:, :, 1:] = np.linalg.inv(information).reshape(SIZE - 1, 3, SIZE - 1, 3)
    scale = np.abs(cov).max()
    for k in range(SIZE):
        np.testing.assert_allclose(found.poses[k], cov[k, :, k], atol=1e-8 * scale)
    for joint, (a, b) in zip(found.pairs, pairs, strict=True):
        both = [[cov[a, :, a], cov[a, :, b]], [cov[b, :, a], cov[b, :, b]]]
        np.testing.assert_allclose(joint, np.array(both), atol=1e-8 * scale)
    assert found.singular == -1


def test_a_batch_has_the_optimum_of_each_graph():
    many = [ring(seed) for seed in range(3)]
    plan = graphs.plan(many[0])
    batch = jax.tree.map(lambda *rows: np.stack(rows), *many)
    found = jax.jit(jax.vmap(lambda g: graphs.optimize(g, plan=plan)))(batch)
    for k, graph in enumerate(many):
        np.testing.assert_allclose(found.chi2[k], dense(graph)[1], rtol=1e-10)
    assert (found.status == Ending.CONVERGED).all()


def test_derivatives_of_the_optimum_are_differences():
    """By measurements, information and the fixed pose."""
    graph, rng = ring(spread=20.0), np.random.default_rng(1)
    plan, table = graphs.plan(graph), graph.tables["relative_pose"]
    look = rng.normal(size=(SIZE, 3))
    away = rng.normal(size=table.information.shape)
    tangent = (
        rng.normal(size=table.z.shape),
        10 * (away + np.swapaxes(away, 1, 2)),
        rng.normal(size=3),
    )

    start = jax.numpy.asarray(graph.poses)

    def seen(z, information, first):
        tables = {"relative_pose": table._replace(z=z, information=information)}
        moved = graph._replace(poses=start.at[0].set(first), tables=tables)
        found = graphs.optimize(moved, plan=plan)
        return (found.graph.poses * look).sum() + found.chi2

    at = table.z, table.information, graph.poses[0]
    gradient = jax.jit(jax.grad(seen, (0, 1, 2)))(*at)
    slope = sum((g * t).sum() for g, t in zip(gradient, tangent, strict=True))
    high, low = (
        seen(*(x + h * t for x, t in zip(at, tangent, strict=True))) for h in (1e-5, -1e-5)
    )
    np.testing.assert_allclose(slope, (high - low) / 2e-5, rtol=1e-6)


def falsified(graph, false=((2, 12), (6, 15))):
    """The graph with false loop closures in a table of their own, which agree with each other."""
    table = graph.tables["relative_pose"]
    who = np.array(false, np.int32)
    z = between(graph.poses[who[:, 0]], graph.poses[who[:, 1]]) + [3.0, -2.0, 0.5]
    many = np.array([np.concatenate([who, table.who[SIZE:]])])[0]
    loops = Table(
        many,
        np.concatenate([z, table.z[SIZE:]]),
        np.concatenate([table.information[: len(who)], table.information[SIZE:]]),
        np.ones(len(many), bool),
    )
    odometry = Table(*(field[:SIZE] for field in table))
    return graph._replace(
        tables={"relative_pose": odometry, "relative_pose/loops": loops}
    ), graph._replace(poses=graph.poses)


@pytest.mark.parametrize("name", ["dcs", "truncated"])
def test_a_redescending_kernel_leaves_false_loop_closures_out(name):
    graph, clean = falsified(ring())
    poses, _, _, _ = dense(clean)
    kernel = graphs.KERNELS[name]()
    found = graphs.optimize(graph, kernel={"relative_pose/loops": kernel})
    s = graphs.squares(found.graph)["relative_pose/loops"]
    weights = np.asarray(kernel.weight(s))
    assert found.status == Ending.CONVERGED
    assert (weights[:2] < 1e-3).all()
    if name == "truncated":  # binary: the others' own optimum
        assert (weights[2:] == 1).all()
        np.testing.assert_allclose(found.graph.poses[:, :2], poses[:, :2], atol=1e-6)


@pytest.mark.parametrize("name", sorted(graphs.KERNELS))
def test_the_weight_of_a_kernel_is_the_slope_of_its_cost(name):
    kernel, s, h = graphs.KERNELS[name](), np.array([0.0, 0.3, 2.0, 9.0, 40.0, 1e4]), 1e-6
    slope = (np.asarray(kernel.cost(s + h)) - np.asarray(kernel.cost(np.maximum(s - h, 0)))) / (
        s + h - np.maximum(s - h, 0)
    )
    np.testing.assert_allclose(kernel.weight(s), slope, atol=1e-5)
    np.testing.assert_allclose(kernel.cost(np.array([0.0, 1e-3])), [0, 1e-3], rtol=1e-3)
