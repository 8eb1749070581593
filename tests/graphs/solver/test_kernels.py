"""Robust kernels: their own equations, and what they leave out."""

import jax
import numpy as np
import pytest
from pose_rings import SIZE, between, dense, ring

from jaxslam import graphs
from jaxslam.graphs import Ending, Table


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
    poses, _, information, _ = dense(clean)
    kernel = graphs.KERNELS[name]()
    found = graphs.optimize(graph, kernel={"relative_pose/loops": kernel})
    s = graphs.squared_residuals(found.graph)["relative_pose/loops"]
    weights = np.asarray(found.weights["relative_pose/loops"])
    np.testing.assert_allclose(weights, kernel.weight(s), rtol=1e-9)
    assert found.status == Ending.CONVERGED
    assert (weights[:2] < 1e-3).all() and (found.weights["relative_pose"] == 1).all()
    if name == "truncated":  # binary: the others' own optimum
        assert (weights[2:] == 1).all()
        np.testing.assert_allclose(found.graph.poses[:, :2], poses[:, :2], atol=1e-6)
        # The covariance is that without the false ones; they would make it smaller.
        cov = np.linalg.inv(information)[-3:, -3:]
        np.testing.assert_allclose(graphs.marginals(found).poses[-1], cov, rtol=1e-5, atol=1e-9)
        with pytest.raises(ValueError, match=r"expected a Solution.* got a Graph; of a graph as"):
            graphs.marginals(found.graph)


def test_the_robust_start_is_good_and_is_kept():
    """Three loops of seven are false; NumPy has the optimum without them."""
    graph, clean = falsified(ring(spread=0.2), ((2, 12), (6, 15), (1, 9)))
    poses = dense(clean)[0]
    start = graphs.starts.robust(graph)
    off = np.asarray(graphs.starts.odometry(graph).poses)[:, :2] - poses[:, :2]
    left = start.poses[:, :2] - poses[:, :2]
    assert np.abs(left).max() < 0.2 * np.abs(off).max() and start.tables is graph.tables
    found = graphs.optimize(start, kernel={"relative_pose/loops": graphs.Truncated()})
    np.testing.assert_allclose(found.graph.poses[:, :2], poses[:, :2], atol=1e-6)
    assert found.iterations < 10  # weights of zero and one at once, without rounds


@pytest.mark.parametrize(("name", "share"), [("huber", 0.5), ("cauchy", 0.1)])
def test_other_kernels_reduce_the_pull_of_false_loop_closures(name, share):
    """The optimum lies nearer to that without false ones than least squares does, in NumPy."""
    graph, clean = falsified(ring())
    both = Table(*map(np.concatenate, zip(*graph.tables.values(), strict=True)))
    plain = dense(clean._replace(tables={"relative_pose": both}))[0]
    found = graphs.optimize(graph, kernel={"relative_pose/loops": graphs.KERNELS[name]()})
    best = dense(clean)[0]
    assert found.status == Ending.CONVERGED
    pulled, free = (
        np.sqrt(((poses[:, :2] - best[:, :2]) ** 2).sum(axis=1).mean())
        for poses in (plain, np.asarray(found.graph.poses))
    )
    assert pulled > 0.4
    assert free < share * pulled


@pytest.mark.parametrize("name", sorted(graphs.KERNELS))
def test_the_weight_of_a_kernel_is_the_slope_of_its_cost(name):
    kernel, s, h = graphs.KERNELS[name](), np.array([0.0, 1e-3, 0.3, 2.0, 9.0, 40.0, 1e4]), 1e-6
    both = jax.jit(lambda s: (kernel.cost(s), kernel.weight(s)))
    low, high = np.maximum(s - h, 0), s + h
    slope = (np.asarray(both(high)[0]) - both(low)[0]) / (high - low)
    cost, weight = both(s)
    np.testing.assert_allclose(weight, slope, atol=1e-5)
    np.testing.assert_allclose(cost[:2], [0, 1e-3], rtol=1e-3)


@pytest.mark.parametrize("name", graphs.KERNELS)
def test_a_width_is_above_zero(name):
    for width in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(
            ValueError, match=f"^{graphs.KERNELS[name].__name__}: expected width above 0"
        ):
            graphs.KERNELS[name](width)
