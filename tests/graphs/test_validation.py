"""What is refused before a graph is solved, each with the row or the variable."""

import numpy as np
import pytest
import small_graphs
from cases import refused
from own_models import made

from jaxslam import graphs

GRAPH = small_graphs.drawn()


def spoiled(graph, table, field, at, value):
    """The graph with one number of a table changed."""
    whole = np.array(getattr(graph.tables[table], field))
    whole[at] = value
    changed = graph.tables[table]._replace(**{field: whole})
    return graph._replace(tables=graph.tables | {table: changed})


def at(graph, field, at, value):
    whole = np.array(getattr(graph, field))
    whole[at] = value
    return graph._replace(**{field: whole})


def loose(graph, fixed=False, informed=True):
    """Pose 17 in no row, or in rows without information; either it or pose 10 fixed; no prior."""
    graph = small_graphs.only(graph, "relative_pose")
    table = graph.tables["relative_pose"]
    others = (table.who != 7).all(axis=1)
    if informed:
        table = table._replace(valid=others)
    else:
        table = table._replace(information=table.information * others[:, None, None])
    graph = graph._replace(tables={"relative_pose": table}, points=np.zeros((0, 2)))
    graph = graph._replace(fixed_point=np.zeros(0, bool), point_id=np.zeros(0, np.int32))
    return at(graph, "fixed_pose", 7, fixed)


@refused(
    (lambda g: at(g, "pose_id", 3, 12), "pose 12 occurs twice"),
    (lambda g: at(g, "poses", (4, 1), np.nan), "pose 14 is not finite"),
    (lambda g: at(g, "points", (2, 0), np.inf), "point 2 is not finite"),
    (
        lambda g: spoiled(g, "bearing", "z", (3, 0), np.nan),
        r"bearing, row 3 \(pose 11, point 2\): z is not finite",
    ),
    (
        lambda g: spoiled(g, "relative_pose", "information", (2, 0, 0), np.nan),
        r"relative_pose, row 2 \(pose 12, pose 13\): the information is not finite",
    ),
    (
        lambda g: spoiled(g, "relative_pose", "information", (1, 0, 0), -1.0),
        r"relative_pose, row 1 \(pose 11, pose 12\): the information is not positive semidefinite",
    ),
    (
        lambda g: spoiled(g, "relative_position", "information", (0, 0, 1), 99.0),
        r"row 0 \(pose 10, point 0\): the information is not symmetric",
    ),
    (
        lambda g: spoiled(g, "relative_position", "who", (2, 1), 3),
        "relative_position, row 2: point index 3 is out of range: the graph has 3 points",
    ),
    (
        lambda g: spoiled(g, "relative_pose", "who", (2, 1), 2),
        r"relative_pose, row 2 \(pose 12, pose 12\): joins a variable to itself",
    ),
    (
        lambda g: g._replace(
            tables={k: t._replace(valid=np.zeros(len(t.z), bool)) for k, t in g.tables.items()}
        ),
        "the graph has no measurement",
    ),
    (
        lambda g: g._replace(
            tables={},
            **{field: getattr(g, field)[:1] for field in ("poses", "fixed_pose", "pose_id")},
        ),
        "the graph has no measurement",
    ),
    (
        lambda g: at(small_graphs.only(g, "relative_pose", "bearing"), "fixed_pose", 0, False),
        "the graph has no gauge: fix a pose",
    ),
    (
        loose,
        "the graph is disconnected: no measurement with information joins pose 17 to a fixed pose",
    ),
    (
        lambda g: loose(g, informed=False),
        "the graph is disconnected: no measurement with information joins pose 17 to a fixed pose",
    ),
    (
        lambda g: spoiled(
            at(small_graphs.only(g, "relative_pose", "prior"), "fixed_pose", 0, False),
            *("prior", "information", 0, 0.0),
        )._replace(points=np.zeros((0, 2)), fixed_point=np.zeros(0, bool), point_id=np.zeros(0)),
        "the graph has no gauge: fix a pose",
    ),
    (
        lambda g: g._replace(tables={"bearing": g.tables["relative_pose"]}),
        r"table 'bearing': z: expected shape \(10, 1\), got \(10, 3\)",
    ),
    (
        lambda g: g._replace(tables={"odometer": g.tables["prior"]}),
        "table 'odometer' has no factor; there are: bearing, prior",
    ),
)
def test_what_is_refused(spoil):
    graphs.check_graph(spoil(GRAPH), graphs.REGISTRY)


def test_what_is_not_valid_is_not_judged():
    graphs.check_graph(GRAPH, graphs.REGISTRY)
    graph = spoiled(small_graphs.drawn(), "relative_pose", "information", (9, 0, 0), -1.0)
    graph = spoiled(graph, "relative_pose", "who", 9, -7)
    graph = spoiled(graph, "relative_pose", "valid", 9, False)
    graphs.check_graph(graph, graphs.REGISTRY)


def test_parts_with_a_gauge_each_are_a_graph():
    graphs.check_graph(loose(small_graphs.drawn(), fixed=True), graphs.REGISTRY)


def test_a_part_that_is_fixed_needs_no_gauge():
    """A point that no row sees, fixed, as `of_log` leaves those of its capacity."""
    graph = small_graphs.drawn()
    unseen = graph._replace(
        points=np.vstack([graph.points, [[0.0, 0.0]]]),
        fixed_point=np.append(graph.fixed_point, True),
        point_id=np.append(graph.point_id, 99),
    )
    graphs.check_graph(unseen, graphs.REGISTRY)
    free = small_graphs.only(at(unseen, "fixed_pose", 0, False), "relative_pose")
    free = free._replace(points=unseen.points[-1:], fixed_point=np.ones(1, bool))
    free = free._replace(point_id=unseen.point_id[-1:])
    with pytest.raises(ValueError, match="the graph has no gauge"):
        graphs.check_graph(free, graphs.REGISTRY)
    graphs.check_graph(graphs.with_gauge(free), graphs.REGISTRY)


def test_a_fixed_pose_that_nothing_joins_to_the_other_is_no_missing_gauge():
    graph = small_graphs.only(small_graphs.drawn(), "relative_pose")
    zero = graph.tables["relative_pose"]
    zero = zero._replace(information=np.zeros_like(zero.information))
    two = graph._replace(
        poses=graph.poses[:2],
        fixed_pose=np.array([True, False]),
        pose_id=graph.pose_id[:2],
        points=np.zeros((0, 2)),
        fixed_point=np.zeros(0, bool),
        point_id=np.zeros(0, int),
        tables={"relative_pose": type(zero)(*(part[:1] for part in zero))},
    )
    with pytest.raises(ValueError, match=r"disconnected: .* joins pose 11 .*; 2 parts, 1 of"):
        graphs.check_graph(two, graphs.REGISTRY)


def test_another_kind_of_number_is_refused():
    graph = small_graphs.drawn()
    table = graph.tables["prior"]
    for spoilt, message in (
        (table._replace(valid=table.valid.astype(int)), "valid: expected bool values, got int"),
        (table._replace(who=table.who.astype(float)), "who: expected integer values, got float"),
        (table._replace(valid=table.valid.tolist()), "valid: expected an array, got a list"),
    ):
        with pytest.raises(ValueError, match=f"table 'prior': {message}"):
            graphs.optimize(graph._replace(tables=graph.tables | {"prior": spoilt}))
    with pytest.raises(ValueError, match="fixed_pose: expected bool values, got int"):
        graphs.optimize(graph._replace(fixed_pose=graph.fixed_pose.astype(int)))


def test_whole_numbers_are_real_ones():
    """Of poses and of measurements, by optimization and by starts."""
    steps = np.array([[2, 0, 1], [1, 1, 0]])
    table = graphs.Table(
        np.array([[0, 1], [1, 2]]),
        steps,
        np.tile(np.eye(3, dtype=int), (2, 1, 1)),
        np.ones(2, bool),
    )
    graph = graphs.Graph(
        poses=np.zeros((3, 3), int),
        points=np.zeros((0, 2)),
        tables={"relative_pose": table},
        fixed_pose=np.arange(3) == 0,
        fixed_point=np.zeros(0, bool),
        pose_id=np.arange(3),
        point_id=np.arange(0),
    )
    end = [2 + np.cos(1) - np.sin(1), np.sin(1) + np.cos(1), 1]
    np.testing.assert_allclose(graphs.starts.odometry(graph).poses[2], end, atol=1e-12)
    np.testing.assert_allclose(graphs.optimize(graph).graph.poses[2], end, atol=1e-6)


def test_a_tolerance_is_a_number_from_zero_on():
    for tolerance in (-1.0, np.nan):
        with pytest.raises(ValueError, match="tolerance: expected a finite number >= 0"):
            graphs.optimize(small_graphs.drawn(), tolerance=tolerance)


def test_rounding_of_a_file_is_not_indefinite():
    graph = small_graphs.drawn()
    flat = np.diag([1e4, 1e4, -1e-3])
    graph = spoiled(graph, "relative_pose", "information", 0, flat)
    graphs.check_graph(graph, graphs.REGISTRY)


def test_the_first_pose_is_fixed_where_nothing_is():
    free = at(small_graphs.drawn(), "fixed_pose", 0, False)
    held = graphs.with_gauge(small_graphs.only(free, "relative_pose"))
    assert held.fixed_pose.tolist() == [True] + [False] * 7
    for graph in (free, small_graphs.only(small_graphs.drawn(), "relative_pose")):
        assert graphs.with_gauge(graph) is graph  # a prior; a fixed pose


@pytest.mark.parametrize(
    ("residual", "got"),
    [
        (lambda v, z: (v[0] - z)[:2], r"\(2,\)"),
        (lambda v, z: (v[0] - z).sum(), r"\(\)"),
        (lambda v, z: (v[0][0], z), "tuple"),
    ],
)
def test_a_residual_of_another_shape_is_refused(residual, got):
    """By all that takes factors: optimization, χ², residuals, and the plan."""
    names = ("x [m]", "y [m]", "theta [rad]")
    names = {"measurements": names, "errors": names, "name": "mine"}
    factors = {"prior": made(graphs.Factor, variables=("pose",), residual=residual, **names)}
    graph = small_graphs.only(small_graphs.drawn(), "prior")
    told = r"the factor 'mine' of table 'prior': expected a residual of shape \(3,\), as its errors"
    for use in (graphs.optimize, graphs.chi2, graphs.squared_residuals, graphs.plan):
        with pytest.raises(
            ValueError, match=rf"graphs\.{use.__name__}: factors: {told} .*, got {got}"
        ):
            use(graph, factors)


@refused(
    (lambda: graphs.optimize("x.g2o"), r"graphs\.optimize: graph: expected a Graph, got 'x\.g2o';"),
    (
        lambda: graphs.chi2(None),
        r"graphs\.chi2: graph: expected a Graph, got None; datasets\.read_graph\(path\)",
    ),
    (
        lambda: graphs.starts.chordal("x.g2o"),
        r"chordal: graph: expected a Graph, got 'x\.g2o'; datasets\.read_graph\(path\)",
    ),
    (lambda: graphs.plan(GRAPH.tables), "plan: graph: expected a Graph, got a dict"),
    (
        lambda: graphs.optimize(GRAPH, kernel=graphs.DynamicCovarianceScaling),
        r"graphs\.optimize: kernel: expected a Kernel, got the class",
    ),
    (
        lambda: graphs.chi2(GRAPH, kernel={"bearing": "dcs"}),
        r"graphs\.chi2: kernel: expected a Kernel, got 'dcs'; graphs\.Huber\(\) is one",
    ),
    (
        lambda: graphs.optimize(GRAPH, {"bearing": graphs.Bearing}),
        r"graphs\.optimize: factors: expected a Factor, got the class Bearing: call",
    ),
    (
        lambda: graphs.optimize(GRAPH, graphs.Bearing()),
        r"graphs\.optimize: factors: expected a dict by table, got a Bearing",
    ),
    (lambda: graphs.optimize(GRAPH, iterations=-1), "iterations: expected an integer >= 0"),
    (
        lambda: graphs.marginals(GRAPH),
        r"graphs\.marginals: solution: expected a Solution, got a Graph; of a graph",
    ),
)
def test_another_thing_than_the_argument_is_named(call):
    call()
