"""The optimum and χ² of graphs: against dense Gauss-Newton in NumPy, and GTSAM; room for more variables."""

import jax
import numpy as np
import own_models
import pytest
import small_graphs
from cases import swept
from pose_rings import SIZE, dense, ring
from recordings import DATA
from reference import graph as plain
from reference.plane import between, wrap
from worlds import nothing_compiled

from jaxslam import datasets, graphs
from jaxslam.graphs import Ending, starts

pytestmark = pytest.mark.decision


def test_the_optimum_is_that_of_dense_gauss_newton():
    graph = ring()
    poses, chi2, _, _ = dense(graph)
    solution = graphs.optimize(graph)
    assert solution.status == Ending.CONVERGED
    np.testing.assert_allclose(solution.chi2, chi2, rtol=1e-10)
    np.testing.assert_allclose(solution.graph.poses[:, :2], poses[:, :2], atol=1e-6)
    np.testing.assert_allclose(wrap(solution.graph.poses[:, 2] - poses[:, 2]), 0, atol=1e-7)
    np.testing.assert_allclose(graphs.chi2(solution.graph), chi2, rtol=1e-10)
    assert solution.gradient < 1e-6 * solution.gradient_start
    assert solution.singular == -1


@pytest.mark.parametrize("dtype", swept([np.float64, np.float32], np.float64))
def test_poses_and_points_are_those_of_scipy(dtype):
    """With every kind of measurement."""
    graph = small_graphs.drawn(noise=0.1)
    poses, points, chi2 = plain.optimum(graph)
    numbers = jax.tree.map(lambda x: x.astype(dtype) if x.dtype == np.float64 else x, graph)
    solution = graphs.optimize(numbers)
    assert solution.status == Ending.CONVERGED and solution.chi2.dtype == dtype
    near = 1e-6 if dtype == np.float64 else 1e-3
    np.testing.assert_allclose(solution.chi2, chi2, rtol=near)
    np.testing.assert_allclose(solution.graph.poses[:, :2], poses[:, :2], atol=near)
    np.testing.assert_allclose(wrap(solution.graph.poses[:, 2] - poses[:, 2]), 0, atol=near)
    np.testing.assert_allclose(solution.graph.points, points, atol=near)


def test_endings():
    """Of one program, and of a residual whose derivatives have the wrong sign."""
    graph = ring()
    table, factor = graph.tables["relative_pose"], graphs.RelativePose()

    def ended(of, **options):
        solution = graphs.optimize(of, **options)
        assert np.isfinite(solution.graph.poses).all()
        return Ending(int(solution.status)), int(solution.singular)

    def changed(field, rows, value):
        numbers = np.array(getattr(table, field))
        numbers[rows] = value
        return graph._replace(tables={"relative_pose": table._replace(**{field: numbers})})

    def uphill(variables, z):
        e = factor.residual(variables, z)
        return 2 * jax.lax.stop_gradient(e) - e

    assert ended(graph, iterations=1) == (Ending.EXHAUSTED, -1)
    assert ended(changed("z", 5, 1e200))[0] == Ending.DIVERGED
    heading_alone = changed("information", slice(18, 20), np.diag([0.0, 0.0, 40.0]))
    assert ended(heading_alone) == (Ending.SINGULAR, 19)
    wrong = own_models.changed(factor, residual=uphill, jacobians=None)
    assert ended(graph, factors={"relative_pose": wrong})[0] == Ending.STALLED


def test_graphs_of_about_the_same_size_share_their_programs():
    """Of other poses, loops and pairs; what is found is of the graph's own sizes."""

    table, graph_of_poses = ring(1).tables["relative_pose"], ring(1)._replace(tables={})
    rows = np.flatnonzero((table.who < 19).all(axis=1))
    smaller = jax.tree.map(lambda x: x[:19], graph_of_poses)
    smaller.tables["relative_pose"] = jax.tree.map(lambda x: x[rows], table)

    def solved(graph, pairs):
        solution = graphs.optimize(graph)
        return solution, graphs.marginals(solution, pairs=pairs)

    solved(ring(), [[3, 4]])
    with nothing_compiled():
        solution, marginals = solved(smaller, [[2, 7], [1, 18], [3, 3]])
    assert jax.tree.map(np.shape, solution.graph) == jax.tree.map(np.shape, smaller)
    assert marginals.poses.shape == (19, 3, 3) and marginals.pairs.shape == (3, 2, 2, 3, 3)
    _, chi2, information, _ = dense(smaller)
    np.testing.assert_allclose(solution.chi2, chi2, rtol=1e-10)


def split(graph):
    """The graph with its rows in two tables, whose names are not in the order of the alphabet."""
    table = graph.tables["relative_pose"]
    odd = np.arange(len(table.z)) % 2
    parts = (("second", table.valid & (odd == 1)), ("first", table.valid & (odd == 0)))
    tables = {f"relative_pose/{name}": table._replace(valid=valid) for name, valid in parts}
    return graph._replace(tables=tables)


@pytest.mark.sweep
def test_a_batch_has_the_optimum_of_each_graph():
    """Of more than one group, the last of which is not full; with tables in another order than in
    the plan: `jax.tree.map` sorts the names of a dictionary, which those of a file need not be."""
    many = [ring(seed) for seed in range(18)]
    plan = graphs.plan(split(many[0]))
    batch = jax.tree.map(lambda *rows: np.stack(rows), *map(split, many))

    @jax.jit
    @jax.vmap
    def solved(graph):
        solution = graphs.optimize(graph, plan=plan)
        return solution, graphs.certificate(solution.graph, plan=plan)

    solution, proof = solved(batch)
    for k in (0, 3, 17):
        np.testing.assert_allclose(solution.chi2[k], dense(many[k])[1], rtol=1e-10)
        alone = graphs.certificate(graphs.optimize(many[k]).graph)
        np.testing.assert_allclose(proof.chi2[k], alone.chi2, rtol=1e-9)
    assert (solution.status == Ending.CONVERGED).all()
    assert proof.certified.all()


@pytest.mark.sweep
def test_derivatives_of_the_optimum_are_differences():
    """By measurements, information and the fixed pose; with a kernel, and of its weights."""
    kernel = graphs.Cauchy(30.0)  # its weights change little: differences need a sharp optimum
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
        solution = graphs.optimize(moved, plan=plan, kernel=kernel, tolerance=0.0)
        poses, weights = solution.graph.poses, solution.weights["relative_pose"]
        by_poses = (poses[:, :2] * look[:, :2]).sum() + jax.numpy.sin(poses[:, 2]).sum()
        return by_poses + solution.chi2 + weights @ look.ravel()[: len(weights)]

    at = table.z, table.information, graph.poses[0]
    gradient = jax.jit(jax.grad(seen, (0, 1, 2)))(*at)
    slope = sum((g * t).sum() for g, t in zip(gradient, tangent, strict=True))
    high, low = (
        seen(*(x + h * t for x, t in zip(at, tangent, strict=True))) for h in (1e-5, -1e-5)
    )
    np.testing.assert_allclose(slope, (high - low) / 2e-5, rtol=1e-6)


@pytest.mark.sweep
def test_priors_alone_and_what_is_not_determined():
    """A graph without a measurement of two variables; a singular start with a regular end."""
    prior = graphs.Table(np.zeros((1, 1), int), np.ones((1, 3)), np.eye(3)[None], np.ones(1, bool))
    alone = graphs.Graph(
        poses=np.zeros((1, 3)),
        points=np.zeros((0, 2)),
        pose_id=np.arange(1),
        point_id=np.arange(0),
        fixed_pose=np.zeros(1, bool),
        fixed_point=np.zeros(0, bool),
        tables={"prior": prior},
    )
    solution = graphs.optimize(alone)
    assert solution.status == Ending.CONVERGED
    np.testing.assert_allclose(solution.graph.poses, 1.0, atol=1e-9)

    def at(value, z):
        return z - value[0][:2]

    names = {
        "variables": ("pose",),
        "measurements": ("x [m]", "y [m]"),
        "errors": ("x [m]", "y [m]"),
    }
    place = own_models.made(graphs.Factor, residual=at, **names)
    factors = {"place": place, "relative_pose": graphs.RelativePose()}
    steps = graphs.Table(
        np.array([[0, 1], [1, 2]]),
        np.tile([1.0, 0, 0], (2, 1)),
        np.tile(100.0 * np.eye(3), (2, 1, 1)),
        np.ones(2, bool),
    )
    places = graphs.Table(
        np.array([[0], [2]]),
        np.array([[0.0, 0.0], [2.0, 1.0]]),
        np.tile(10.0 * np.eye(2), (2, 1, 1)),
        np.ones(2, bool),
    )
    graph = alone._replace(
        poses=np.zeros((3, 3)),
        pose_id=np.arange(3),
        fixed_pose=np.zeros(3, bool),
        tables={"place": places, "relative_pose": steps},
    )
    solution = graphs.optimize(graph, factors)
    assert solution.status == Ending.CONVERGED and solution.singular == -1
    again = graphs.optimize(solution.graph, factors)
    np.testing.assert_allclose(solution.chi2, again.chi2, rtol=1e-9)

    nothing = steps._replace(information=np.tile(np.diag([0.0, 0.0, 1.0]), (2, 1, 1)))
    loose = graph._replace(tables={"prior": prior, "relative_pose": nothing})
    with pytest.raises(ValueError, match="marginals: the measurements do not determine pose"):
        graphs.marginals(graphs.optimize(loose))
    with pytest.raises(ValueError, match="expected a Kernel"):
        graphs.optimize(alone, kernel="huber")
    with pytest.raises(
        ValueError, match=r"graphs\.optimize: fixed_pose: expected shape \(1,\), got \(2,\)"
    ):
        graphs.optimize(alone._replace(fixed_pose=np.zeros(2, bool)))


# --- Squared residuals and degrees of freedom against plain NumPy ---------------------------------


def test_squared_residuals_are_those_of_the_equations():
    graph = small_graphs.drawn(noise=0.5)
    table = graph.tables["relative_pose"]._replace(valid=np.arange(10) != 4)
    graph = graph._replace(tables=graph.tables | {"relative_pose": table})
    squares = graphs.squared_residuals(graph)
    assert {key: len(rows) for key, rows in squares.items()} == {
        key: len(table.z) for key, table in graph.tables.items()
    }
    assert squares["relative_pose"][4] == 0
    total = sum(np.asarray(rows).sum() for rows in squares.values())
    np.testing.assert_allclose(total, plain.chi2(graph), rtol=1e-13)


def test_degrees_of_freedom():
    graph = small_graphs.drawn(fixed_point=np.array([True, False, False]))
    # 10 relative poses, 16 relative positions, 5 bearings, a prior; 7 poses and 2 points are free.
    assert graphs.degrees_of_freedom(graph) == 30 + 32 + 5 + 3 - 21 - 4


# --- The optima of real graphs, whose χ² GTSAM 4.3 found from several starts ----------------------


@pytest.mark.parametrize(
    ("name", "start", "best"),
    swept(
        [("ring", "given", 11.1631), ("ring", "chordal", 11.1631), ("CSAIL", "chordal", 40.55088)],
        ("ring", "given", 11.1631),
    ),
)
def test_they_are_gtsams(name, start, best):
    """Of the logarithm of the error, which is GTSAM's; to the digits that were noted."""
    path = DATA / "graphs" / f"{name}.g2o"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    graph = graphs.with_gauge(datasets.read_graph(path))
    begun = starts.STARTS[start](graph)
    solution = graphs.optimize(begun, {"relative_pose": graphs.RelativePoseLog()})
    assert solution.status == Ending.CONVERGED
    np.testing.assert_allclose(solution.chi2, best, rtol=1e-6)
    assert solution.gradient < 1e-6 * solution.gradient_start
    # That of the error itself lies close by, where it is not yet a minimum.
    near = plain.chi2(graph._replace(poses=np.asarray(solution.graph.poses)))
    np.testing.assert_allclose(near, best, rtol=1e-3)


# --- Room for more variables: the same numbers, and one program for all graphs that fit -----------


ROOM = 64
LOOPS = "relative_pose/loops"
KERNEL = {LOOPS: graphs.Cauchy()}
PAIRS = np.array([[3, 4], [9, 2], [7, 19], [0, 11]])


def with_loops(graph):
    """Its chords in a table of their own, as laser SLAM has them."""
    table = graph.tables["relative_pose"]
    chain = type(table)(*(part[:SIZE] for part in table))
    chords = type(table)(*(part[SIZE:] for part in table))
    return graph._replace(tables={"relative_pose": chain, LOOPS: chords})


def larger(graph, more=12):
    """With poses on from the last one."""
    table = graph.tables["relative_pose"]
    poses = np.concatenate([graph.poses, graph.poses[-1] + np.arange(1, more + 1)[:, None]])
    first = SIZE - 1 + np.arange(more)
    z = between(poses[first], poses[first + 1]) + 0.01
    chain = type(table)(
        np.concatenate([table.who, np.stack([first, first + 1], axis=1)]).astype(np.int32),
        np.concatenate([table.z, z]),
        np.concatenate([table.information, np.broadcast_to(100 * np.eye(3), (more, 3, 3))]),
        np.ones(len(table.z) + more, bool),
    )
    return graph._replace(
        poses=poses,
        tables={**graph.tables, "relative_pose": chain},
        fixed_pose=np.arange(SIZE + more) == 0,
        pose_id=np.arange(SIZE + more),
    )


@pytest.mark.sweep
@pytest.mark.parametrize("kernel", swept([None, KERNEL], KERNEL))
def test_the_numbers_are_those_without_room(kernel):
    graph = with_loops(ring(spread=3.0))
    without, with_room = (graphs.optimize(graph, kernel=kernel, room=room) for room in (0, ROOM))
    np.testing.assert_allclose(with_room.graph.poses, without.graph.poses, rtol=0, atol=1e-9)
    np.testing.assert_allclose(with_room.chi2, without.chi2, rtol=1e-9)
    assert with_room.singular == without.singular == -1
    assert with_room.graph.poses.shape == (SIZE, 3)
    at = without.graph
    for name, weight in without.weights.items():
        np.testing.assert_allclose(with_room.weights[name], weight, rtol=0, atol=1e-9)
    without, with_room = (graphs.marginals(without, pairs=PAIRS, room=room) for room in (0, ROOM))
    scale = np.abs(without.poses).max()
    assert scale > 0 and with_room.pairs.shape == without.pairs.shape
    np.testing.assert_allclose(with_room.poses, without.poses, rtol=0, atol=1e-9 * scale)
    np.testing.assert_allclose(with_room.pairs, without.pairs, rtol=0, atol=1e-9 * scale)
    without, with_room = (graphs.squared_residuals(at, room=room) for room in (0, ROOM))
    for name, square in without.items():
        assert len(with_room[name]) == len(graph.tables[name].z)
        np.testing.assert_allclose(with_room[name], square, rtol=1e-9, atol=1e-12)


@pytest.mark.sweep
def test_graphs_of_other_sizes_share_a_program():
    small, large = (with_loops(ring(seed=1)), larger(with_loops(ring(seed=2))))
    assert len(large.poses) > 1.5 * len(small.poses)

    def all_of(graph, pairs):
        solution = graphs.optimize(graph, room=ROOM)
        at = solution.graph
        robust = graphs.optimize(graph, kernel=KERNEL, room=ROOM).graph
        covs = graphs.marginals(solution, pairs=pairs, room=ROOM)
        covs_alone = graphs.marginals(solution, room=ROOM)
        np.testing.assert_allclose(covs.poses, covs_alone.poses, rtol=1e-9, atol=1e-15)
        return at, robust, covs, graphs.squared_residuals(at, room=ROOM)

    all_of(small, PAIRS)
    with nothing_compiled():
        at, _, covs, squared = all_of(large, PAIRS[:2])
    assert at.poses.shape == (len(large.poses), 3) and covs.pairs.shape[0] == 2
    np.testing.assert_allclose(
        sum(np.asarray(each).sum() for each in squared.values()), graphs.chi2(at), rtol=1e-9
    )


@pytest.mark.sweep
def test_a_plan_with_room_is_shared_too():
    """One plan a graph, given, as it must be where the graph is traced."""
    graph = with_loops(ring())
    alone, room = graphs.plan(graph), graphs.plan(graph, room=ROOM)
    solutions = [graphs.optimize(graph, plan=plan) for plan in (alone, room)]
    np.testing.assert_allclose(
        solutions[1].graph.poses, solutions[0].graph.poses, rtol=0, atol=1e-9
    )


@pytest.mark.sweep
def test_a_graph_that_is_larger_than_the_room_is_solved_all_the_same():
    graph = larger(with_loops(ring(seed=3)), 80)
    assert len(graph.poses) > ROOM
    alone, with_room = (graphs.optimize(graph, room=room) for room in (0, ROOM))
    np.testing.assert_allclose(with_room.graph.poses, alone.graph.poses, rtol=0, atol=1e-8)


@pytest.mark.sweep
def test_what_is_not_determined_is_told_of_the_graph_that_was_given():
    graph = with_loops(ring())
    tables = dict(graph.tables)
    valid = np.ones(SIZE, bool)
    valid[[SIZE - 2, SIZE - 1]] = False  # the edges of the last pose
    tables["relative_pose"] = tables["relative_pose"]._replace(valid=valid)
    cut = graph._replace(tables=tables)
    with pytest.raises(ValueError, match=f"pose {SIZE - 1}"):
        graphs.marginals(graphs.optimize(cut, room=ROOM, iterations=0), room=ROOM)
