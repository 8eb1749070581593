"""Starts of the optimization against the truth, and against dense NumPy."""

import numpy as np
import pytest
import small_graphs
from recordings import DATA
from reference import graph as plain
from reference import plane
from worlds import narrow

from jaxslam import datasets, graphs, motion, sensors
from jaxslam.graphs import starts

PLACING = ("odometry", "spanning_tree", "chordal")


def scattered(graph):
    """The graph with its free variables elsewhere."""
    random = np.random.default_rng(9)
    free, points = ~graph.fixed_pose[:, None], graph.points
    poses = graph.poses + free * random.normal(size=graph.poses.shape)
    return graph._replace(poses=poses, points=points + random.normal(size=points.shape))


def assert_close(graph, truth, atol=1e-12):
    off = graph.poses - truth.poses
    np.testing.assert_allclose(off[:, :2], 0, atol=atol)
    np.testing.assert_allclose(plane.wrap(off[:, 2]), 0, atol=atol)
    assert (np.abs(graph.poses[:, 2]) <= np.pi).all()


@pytest.mark.parametrize("name", PLACING)
def test_without_noise_every_start_is_the_truth(name):
    truth = small_graphs.drawn()
    start = starts.STARTS[name](scattered(truth))
    assert_close(start, truth)
    np.testing.assert_allclose(start.points, truth.points, atol=1e-12)
    np.testing.assert_array_equal(start.poses[0], truth.poses[0])
    start = starts.STARTS[name](narrow(scattered(truth)))
    assert start.poses.dtype == start.points.dtype == np.float32
    assert_close(start, truth, atol=2e-6)


@pytest.mark.parametrize("name", PLACING)
def test_a_prior_holds_where_no_pose_is_fixed(name):
    truth = small_graphs.drawn(fixed_pose=np.zeros(8, bool))
    assert_close(starts.STARTS[name](scattered(truth)), truth)


def test_given_is_the_graph():
    graph = small_graphs.drawn()
    assert starts.identity(graph) is graph


def test_odometry_follows_the_path_and_the_tree_the_fewest_edges():
    graph = small_graphs.only(small_graphs.drawn(noise=0.1), "relative_pose")
    z = graph.tables["relative_pose"].z
    path, tree = [graph.poses[0]], {}
    for step in z[:7]:
        path.append(plane.compose(path[-1], step))
    np.testing.assert_allclose(starts.odometry(graph).poses, path, atol=1e-12)
    backwards = plane.between(z[7], [0.0, 0.0, 0.0])
    tree[7] = plane.compose(graph.poses[0], backwards)
    tree[6] = plane.compose(tree[7], plane.between(z[6], [0.0, 0.0, 0.0]))
    poses = starts.spanning_tree(graph).poses
    np.testing.assert_allclose(poses[[7, 6]], [tree[7], tree[6]], atol=1e-12)


def test_chordal_is_two_linear_problems():
    """Headings by dense complex least squares; at them χ² has no slope by any position."""
    graph = small_graphs.only(small_graphs.drawn(noise=0.3), "relative_pose", "relative_position")
    start = starts.chordal(graph)
    table = graph.tables["relative_pose"]
    root = np.sqrt(table.information[:, 2, 2])
    rows = np.zeros((len(root), 8), complex)
    for k, (i, j) in enumerate(table.who):
        rows[k, j], rows[k, i] = root[k], -root[k] * np.exp(1j * table.z[k, 2])
    held = np.exp(1j * graph.poses[0, 2])
    rest = np.linalg.lstsq(rows[:, 1:], -rows[:, 0] * held, rcond=None)[0]
    np.testing.assert_allclose(start.poses[1:, 2], np.angle(rest), atol=1e-12)

    def cost(x):
        poses, points = start.poses.copy(), x[14:].reshape(3, 2)
        poses[1:, :2] = x[:14].reshape(7, 2)
        return plain.chi2(start._replace(poses=poses, points=points))

    best = np.concatenate([start.poses[1:, :2].ravel(), start.points.ravel()])
    slope = [
        (cost(best + step) - cost(best - step)) / 2e-3 for step in 1e-3 * np.eye(len(best))
    ]  # exact for a quadratic
    np.testing.assert_allclose(slope, 0, atol=1e-9 * cost(best + 1))


@pytest.mark.parametrize("name", PLACING)
def test_a_pose_that_nothing_reaches_is_named(name):
    graph = small_graphs.only(small_graphs.drawn(), "relative_pose")
    table = graph.tables["relative_pose"]
    cut = table._replace(valid=(table.who != 4).all(axis=1))
    with pytest.raises(
        ValueError, match=f"{name}: graph: pose 14 is not connected to a fixed pose"
    ):
        starts.STARTS[name](graph._replace(tables={"relative_pose": cut}))


def test_factors_of_models_start_as_those_of_files():
    """The relative poses of a motion are those of its nominal step, and so are their weights."""
    truth = small_graphs.only(small_graphs.drawn(noise=0.2), "relative_pose", "relative_position")
    table = truth.tables["relative_pose"]
    factors = {
        "relative_pose": graphs.FromMotion(motion.PoseIncrement(np.eye(3))),
        "relative_position": graphs.FromSensor(sensors.RelativePosition(np.eye(2))),
    }
    # e of the model is additive in z, that of the file in the frame of z.
    c, s = np.cos(table.z[:, 2]), np.sin(table.z[:, 2])
    turn = np.zeros((len(c), 3, 3))
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1], turn[:, 2, 2] = c, -s, s, c, 1
    turned = table._replace(information=turn @ table.information @ np.swapaxes(turn, 1, 2))
    other = truth._replace(tables=truth.tables | {"relative_pose": turned})
    for name in PLACING:
        mine, theirs = starts.STARTS[name](truth), starts.STARTS[name](other, factors)
        assert_close(theirs, mine, atol=1e-10)
        np.testing.assert_allclose(theirs.points, mine.points, atol=1e-10)


@pytest.mark.parametrize(
    ("name", "best", "share"), [("CSAIL", 40.55088, 1.02), ("intel", 45.00423, 1.06)]
)
def test_chordal_lies_close_to_the_optimum_of_real_graphs(name, best, share):
    path = DATA / "graphs" / f"{name}.g2o"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    chi2 = plain.chi2(starts.chordal(datasets.read_graph(path)))
    assert best < chi2 < share * best


@pytest.mark.parametrize("name", PLACING)
def test_a_row_without_information_places_nothing(name):
    truth = small_graphs.only(small_graphs.drawn(), "relative_pose")
    table = truth.tables["relative_pose"]
    false = graphs.Table(
        np.array([[0, 4]]), np.full((1, 3), 9.0), np.zeros((1, 3, 3)), np.array([True])
    )
    both = graphs.Table(*map(np.concatenate, zip(table, false, strict=True)))
    assert_close(starts.STARTS[name](truth._replace(tables={"relative_pose": both})), truth)


def shuffled(graph):
    """The graph with its poses, its points and the rows of each table in another order."""
    random = np.random.default_rng(4)
    pose, point = random.permutation(len(graph.poses)), random.permutation(len(graph.points))
    at = {"pose": np.argsort(pose), "point": np.argsort(point)}

    def row_order(key, table):
        rows = random.permutation(len(table.z))
        kinds = graphs.REGISTRY[key].variables
        who = np.stack([at[kind][table.who[:, k]] for k, kind in enumerate(kinds)], axis=1)
        return graphs.Table(who[rows], table.z[rows], table.information[rows], table.valid[rows])

    return graph._replace(
        poses=graph.poses[pose],
        points=graph.points[point],
        tables={key: row_order(key, table) for key, table in graph.tables.items()},
        fixed_pose=graph.fixed_pose[pose],
        fixed_point=graph.fixed_point[point],
        pose_id=graph.pose_id[pose],
        point_id=graph.point_id[point],
    )


@pytest.mark.parametrize(
    "tables", [("relative_pose", "relative_position"), ("relative_pose", "prior")]
)
def test_the_order_of_poses_and_rows_has_no_influence(tables):
    """On gauge, loops and starts, with two priors and with edges that occur twice."""
    drawn = small_graphs.drawn(noise=0.1, fixed_pose=np.zeros(8, bool))
    twice = {
        key: graphs.Table(*(np.concatenate([part, part[:3]]) for part in table))
        for key, table in drawn.tables.items()
    }
    twice["relative_pose"].z[-3:] += 0.1
    twice["prior"] = twice["prior"]._replace(
        who=np.array([[6], [3]]), z=twice["prior"].z + [[0], [1]]
    )
    graph = small_graphs.only(drawn._replace(tables=twice), *tables)
    reordered = shuffled(graph)
    for start in (graph, reordered):
        held = graphs.with_gauge(start)
        expected = [] if "prior" in tables else [10]
        assert held.pose_id[held.fixed_pose].tolist() == expected
        apart = graphs.with_loops_apart(start).tables
        who = start.pose_id[apart["relative_pose/loops"].who]
        assert sorted(who.tolist()) == [[12, 16], [15, 11], [17, 10]]
        who = start.pose_id[apart["relative_pose"].who]
        assert sorted(who.tolist()) == sorted([[i, i + 1] for i in [*range(10, 17), 10, 11, 12]])
    for name in PLACING:
        first, second = (starts.STARTS[name](start) for start in (graph, reordered))
        order = np.argsort(second.pose_id)
        np.testing.assert_allclose(second.poses[order], first.poses, atol=1e-12)
        np.testing.assert_allclose(
            second.points[np.argsort(second.point_id)], first.points, atol=1e-12
        )
