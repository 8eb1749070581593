"""The optimum of small graphs, against a dense Gauss-Newton in NumPy."""

import jax
import numpy as np
import pytest
from pose_rings import SIZE, dense, ring, wrap

from jaxslam import graphs
from jaxslam.graphs import Ending


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


def split(graph):
    """The graph with its rows in two tables, whose names are not in the order of the alphabet."""
    table = graph.tables["relative_pose"]
    odd = np.arange(len(table.z)) % 2
    parts = (("second", table.valid & (odd == 1)), ("first", table.valid & (odd == 0)))
    tables = {f"relative_pose/{name}": table._replace(valid=valid) for name, valid in parts}
    return graph._replace(tables=tables)


def test_a_batch_has_the_optimum_of_each_graph():
    """Of more than one group, the last of which is not full; with tables in another order than in
    the plan: `jax.tree.map` sorts the names of a dictionary, which those of a file need not be."""
    many = [ring(seed) for seed in range(18)]
    plan = graphs.plan(split(many[0]))
    batch = jax.tree.map(lambda *rows: np.stack(rows), *map(split, many))

    @jax.jit
    @jax.vmap
    def solved(graph):
        found = graphs.optimize(graph, plan=plan)
        return found, graphs.certificate(found.graph, plan=plan)

    found, proof = solved(batch)
    for k in (0, 3, 17):
        np.testing.assert_allclose(found.chi2[k], dense(many[k])[1], rtol=1e-10)
        alone = graphs.certificate(graphs.optimize(many[k]).graph)
        np.testing.assert_allclose(proof.chi2[k], alone.chi2, rtol=1e-9)
    assert (found.status == Ending.CONVERGED).all()
    assert proof.certified.all()


def test_derivatives_of_the_optimum_are_differences():
    """By measurements, information and the fixed pose."""
    graph, rng = ring(spread=5.0), np.random.default_rng(1)
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
        poses = found.graph.poses
        return (poses[:, :2] * look[:, :2]).sum() + jax.numpy.sin(poses[:, 2]).sum() + found.chi2

    at = table.z, table.information, graph.poses[0]
    gradient = jax.jit(jax.grad(seen, (0, 1, 2)))(*at)
    slope = sum((g * t).sum() for g, t in zip(gradient, tangent, strict=True))
    high, low = (
        seen(*(x + h * t for x, t in zip(at, tangent, strict=True))) for h in (1e-5, -1e-5)
    )
    np.testing.assert_allclose(slope, (high - low) / 2e-5, rtol=1e-6)
