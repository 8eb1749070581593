"""What is known of an optimum: whether it is global, and covariances, against dense matrices."""

import tracemalloc

import jax
import numpy as np
import pytest
import small_graphs
from cases import refused
from pose_rings import SIZE, dense, ring
from reference import graph as plain
from small_graphs import POINTS, POSES

from jaxslam import graphs, sensors
from jaxslam.graphs._sparse.sweeps import Sums, places, sweep

WEIGHTS = np.array([40.0, 40.0, 300.0])


def isotropic(seed=0):
    """A ring without chords."""
    graph = ring(seed)
    table = graph.tables["relative_pose"]
    kept = table._replace(
        information=np.broadcast_to(np.diag(WEIGHTS), table.information.shape).copy(),
        valid=np.arange(len(table.who)) < SIZE,
    )
    return graph._replace(tables={"relative_pose": kept})


def folded(graph):
    """The graph with headings that do not turn around the ring, a start of a wrong optimum."""
    poses = np.array(graph.poses)
    poses[:, 2] = poses[0, 2]
    return graph._replace(poses=poses)


def smallest(graph):
    """(chordal cost, Σλ, smallest eigenvalue of the dual matrix without positions)."""
    table = graph.tables["relative_pose"]
    poses, real = np.asarray(graph.poses), np.asarray(table.valid)
    form = np.zeros((2 * SIZE, 2 * SIZE), complex)
    for (i, j), z in zip(np.asarray(table.who)[real], np.asarray(table.z)[real], strict=True):
        for weight, row in (
            (WEIGHTS[0], {j: 1, i: -1, SIZE + i: -(z[0] + 1j * z[1])}),
            (WEIGHTS[2], {SIZE + j: 1, SIZE + i: -np.exp(1j * z[2])}),
        ):
            a = np.zeros(2 * SIZE, complex)
            for at, value in row.items():
                a[at] = value
            form += weight * np.outer(a.conj(), a)
    x = np.concatenate([poses[:, 0] + 1j * poses[:, 1], np.exp(1j * poses[:, 2])])
    multipliers = (x.conj() * (form @ x)).real[SIZE:]
    p, u = slice(0, SIZE), slice(SIZE, None)
    reduced = form[u, u] - form[u, p] @ np.linalg.pinv(form[p, p]) @ form[p, u]
    values = np.linalg.eigvalsh(reduced - np.diag(multipliers))
    return (x.conj() @ form @ x).real, multipliers.sum(), values[0]


@pytest.mark.parametrize("wrong", [False, True])
def test_it_tells_the_global_optimum_from_another(wrong):
    graph = isotropic()
    solution = graphs.optimize(folded(graph) if wrong else graph)
    proof = graphs.certificate(solution.graph)
    chi2, bound, least = smallest(proof.graph)
    np.testing.assert_allclose(proof.chi2, chi2, rtol=1e-9)
    assert bool(proof.certified) is not wrong
    # The matrix has numbers of some thousands.
    np.testing.assert_allclose(proof.smallest, least, rtol=1e-4, atol=1e-7)
    assert proof.gap >= chi2 - bound - SIZE * min(least, 0) - 1e-9
    if not wrong:
        assert proof.position < 0.1 and proof.heading < 0.1
    else:
        best = graphs.certificate(graphs.optimize(graph).graph)
        assert proof.chi2 > 2 * best.chi2
        assert proof.chi2 - proof.gap <= best.chi2


@pytest.mark.sweep
def test_a_prior_is_a_gauge_and_two_are_refused():
    graph = isotropic()
    prior = graphs.Table(
        np.array([[4]], np.int32), graph.poses[4:5], np.eye(3)[None], np.ones(1, bool)
    )
    free = graph._replace(fixed_pose=np.zeros(SIZE, bool), tables={**graph.tables, "prior": prior})
    proof = graphs.certificate(graphs.optimize(free).graph)
    held = graphs.certificate(graphs.optimize(graph).graph)
    assert proof.certified
    np.testing.assert_allclose(proof.chi2, held.chi2, rtol=1e-9)
    with pytest.raises(ValueError, match="expected one pose that is fixed or has a prior, got 2"):
        graphs.certificate(free._replace(fixed_pose=graph.fixed_pose))


def with_point(name, size):
    """The graph of a ring with a point, measured once."""
    graph = isotropic()
    row = np.zeros((1, 2), np.int32), np.zeros((1, size)), np.eye(size)[None], np.ones(1, bool)
    point = {
        "points": np.ones((1, 2)),
        "fixed_point": np.ones(1, bool),
        "point_id": np.zeros(1, int),
    }
    return graph._replace(tables={**graph.tables, name: graphs.Table(*row)}, **point)


@refused(
    (lambda: graphs.certificate(with_point("bearing", 1)), "'bearing' has no chordal cost"),
    (
        lambda: graphs.certificate(
            with_point("seen", 2),
            {
                "relative_pose": graphs.RelativePose(),
                "seen": graphs.FromSensor(sensors.RelativePosition(np.eye(2), mount=[1, 0, 0.5])),
            },
        ),
        "'seen' has no chordal cost: its factor is relative_pos",
    ),
)
def test_a_factor_without_a_chordal_cost_is_refused(call):
    """Nor has a sensor on a mount, though its name is that of a factor which has one."""
    call()


# --- Marginal covariances, against the dense inverse ----------------------------------------------


def as_it_is(graph):
    """The solution that the graph is, without a step."""
    return graphs.optimize(graph, iterations=0)


def test_marginals_are_the_blocks_of_the_dense_inverse():
    graph = ring()
    pairs = [[3, 4], [9, 2], [7, 19]]  # along an edge, none, none and turned round
    poses, _, information, _ = dense(graph)
    covariances = graphs.marginals(as_it_is(graph._replace(poses=poses)), pairs=pairs)
    cov = np.zeros((SIZE, 3, SIZE, 3))
    cov[1:, :, 1:] = np.linalg.inv(information).reshape(SIZE - 1, 3, SIZE - 1, 3)
    scale = np.abs(cov).max()
    for k in range(SIZE):
        np.testing.assert_allclose(covariances.poses[k], cov[k, :, k], atol=1e-9 * scale)
    for joint, (a, b) in zip(covariances.pairs, pairs, strict=True):
        both = [[cov[a, :, a], cov[a, :, b]], [cov[b, :, a], cov[b, :, b]]]
        np.testing.assert_allclose(joint, np.array(both), atol=1e-9 * scale)
    assert covariances.singular == -1


def test_those_of_points_and_of_poses_with_points_are_too():
    """With every kind of measurement; J by differences of the sixth order."""
    graph = small_graphs.drawn(noise=0.1)
    # A point seen from the pose, one that is not, turned round, two points, a fixed pose.
    pairs = [[1, POSES + 1], [1, POSES], [POSES + 2, 4], [POSES, POSES + 2], [0, POSES]]
    residuals, at, _ = plain.whitened(graph)
    step = 1e-2 * np.eye(len(at))
    sides = zip((1, 2, 3), (3 / 4, -3 / 20, 1 / 60), strict=True)
    jacobian = sum(
        w / 1e-2 * np.array([residuals(at + k * h) - residuals(at - k * h) for h in step]).T
        for k, w in sides
    )
    inverse, free = np.linalg.inv(jacobian.T @ jacobian), 3 * (POSES - 1)
    # Rows and columns of the fixed pose, and of the third number that a point does not have.
    place = np.r_[3 : 3 * POSES, (3 * np.arange(POSES, POSES + POINTS)[:, None] + [0, 1]).ravel()]
    count = POSES + POINTS
    cov = np.zeros((3 * count, 3 * count))
    cov[np.ix_(place, place)] = inverse
    cov = cov.reshape(count, 3, count, 3)
    with pytest.raises(ValueError, match=f"from 0 to {count - 1}, got"):
        graphs.marginals(
            as_it_is(graph), pairs=[[0, count]]
        )  # of the padded graph it is a variable
    covariances = graphs.marginals(as_it_is(graph), pairs=pairs)
    atol = 1e-9 * np.abs(inverse).max()
    for k in range(POINTS):
        np.testing.assert_allclose(
            covariances.points[k], cov[POSES + k, :2, POSES + k, :2], atol=atol
        )
    assert np.abs(inverse[:free, free:]).max() > 1e3 * atol
    for joint, (a, b) in zip(covariances.pairs, pairs, strict=True):
        both = [[cov[a, :, a], cov[a, :, b]], [cov[b, :, a], cov[b, :, b]]]
        np.testing.assert_allclose(joint, np.array(both), atol=atol)


@pytest.mark.parametrize("pairs", [(1, 2), [[1, 2, 3], [4, 5, 6]], [[1.5, 2.0]]])
def test_pairs_are_two_whole_numbers_each(pairs):
    """A table on its side would else be read as other pairs."""
    with pytest.raises(ValueError, match=r"pairs: expected whole numbers, \(Q, 2\), got"):
        graphs.marginals(as_it_is(ring()), pairs=pairs)


def test_tables_of_sums_take_little_more_memory_than_they_hold_in_the_end():
    # A plan with marginals of 15,000 poses has nine million products.
    rng, targets, products = np.random.default_rng(0), 4_000, 1_000_000
    numbers = rng.integers(0, targets, (3, products)).astype(np.int32)
    sums = Sums(np.sort(rng.integers(0, 20, targets)), *numbers, rng.random(products) < 0.5)
    _, place = places(sums, targets)
    tracemalloc.start()
    try:
        tables = sweep(sums, place, place, place)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 3 * sum(part.nbytes for part in jax.tree.leaves(tables))
