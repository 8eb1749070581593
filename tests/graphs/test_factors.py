"""Factors and kernels: their equations in NumPy, the models they are made of, and their records."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_graphs
import worlds
from cases import swept
from own_models import made
from pose_rings import SIZE, dense, ring
from reference import graph as plain
from reference.plane import between

from jaxslam import graphs, motion, sensors
from jaxslam.core.record import record
from jaxslam.graphs import Ending, Table
from jaxslam.graphs._factor import NominalMotion


def test_the_factors_of_files_are_their_equations():
    graph = small_graphs.drawn(noise=1.0)
    for kind, factor in graphs.REGISTRY.items():
        table = graph.tables[kind]
        values = [
            (graph.poses if of == "pose" else graph.points)[table.who[:, k]]
            for k, of in enumerate(factor.variables)
        ]
        residuals = jax.jit(jax.vmap(lambda z, *v, f=factor: f.residual(v, z)))(table.z, *values)
        expected = [plain.error(kind, row, z) for *row, z in zip(*values, table.z, strict=True)]
        sign = -1 if kind in ("relative_position", "bearing") else 1  # z - h, which χ² does not see
        np.testing.assert_allclose(residuals, sign * np.array(expected), atol=1e-12)
        assert residuals.shape == (len(table.z), len(factor.errors))


@pytest.mark.parametrize("kind", ["relative_pose", "prior"])
def test_jacobians_by_hand(kind, assert_jacobians):
    factor, random = graphs.REGISTRY[kind], np.random.default_rng(0)
    drawn = [random.normal(size=(6, 3)) for _ in (*factor.variables, "z")]
    assert_jacobians(
        lambda *v: factor.residual(v[:-1], v[-1]),
        lambda *v: (*factor.jacobians(v[:-1], v[-1]), _by_measurement(factor)(v)),
        drawn,
    )


def _by_measurement(factor):
    return lambda v: jax.jacfwd(factor.residual, argnums=1)(v[:-1], v[-1])


def test_what_is_predicted_has_no_residual():
    random = np.random.default_rng(1)
    turning = motion.Velocity(np.eye(3))
    kinds = {
        "relative_pose": graphs.RelativePose(),
        "relative_position": graphs.RelativePosition(),
        "bearing": graphs.Bearing(),
        "sensor": graphs.FromSensor(sensors.RangeBearing(np.eye(2), mount=(0.3, 0.1, 0.5))),
        "motion": graphs.FromMotion(turning),
    }
    pose = random.normal(size=3)
    z = {kind: random.uniform(0.5, 1.0, len(f.measurements)) for kind, f in kinds.items()}

    @jax.jit
    def left(pose, z):
        return {k: f.residual((pose, f.predict(pose, z[k])), z[k]) for k, f in kinds.items()}

    for kind, residual in left(pose, z).items():
        assert np.abs(residual).max() < 1e-12, kind
    assert graphs.Prior().predict is None
    assert graphs.FromSensor(sensors.Compass([[1.0]])).variables == ("pose",)


@pytest.mark.parametrize("make", swept([motion.Odometry, motion.Velocity], motion.Odometry))
def test_the_residual_of_a_motion_is_its_noise(make):
    """And its derivatives are those of w where step(x, u, w) = x'."""
    model, random = make(np.eye(3)), np.random.default_rng(2)
    factor = graphs.FromMotion(model)
    first, w = random.normal(size=(5, 3)), 0.1 * random.normal(size=(5, 3))
    u = random.uniform(0.4, 1.0, (5, 3))

    @jax.jit
    @jax.vmap
    def all_of(x, u, w):
        second = model.step(x, u, w)
        residual = factor.residual((x, second), u)
        by = jax.jacfwd(lambda x, y: factor.residual((x, y), u), argnums=(0, 1))(x, second)
        return residual, by, model.jacobians(x, u, w)

    noise, (by_first, by_second), (by_pose, _, by_noise) = all_of(first, u, w)
    np.testing.assert_allclose(noise, w, atol=1e-13)
    np.testing.assert_allclose(by_second, np.linalg.inv(by_noise), atol=1e-11)
    np.testing.assert_allclose(by_first, -np.linalg.inv(by_noise) @ by_pose, atol=1e-11)


@pytest.mark.sweep
def test_the_noise_curves_as_the_motion_does():
    """The residual of a motion at the pose that w leads to is w, so its second derivative is 0."""
    model = motion.Odometry(np.eye(3))
    factor = graphs.FromMotion(model)
    x, u, w = np.array([0.5, -1.0, 2.0]), np.array([0.4, 0.8, -0.3]), np.array([0.1, -0.1, 0.05])

    def around(v):
        return factor.residual((x, model.step(x, u, v)), u)

    def twice(v):
        return jax.jvp(lambda s: jax.jvp(around, (s,), (u,))[1], (v,), (u,))

    slope, curve = jax.jit(twice)(w)
    np.testing.assert_allclose(slope, u, atol=1e-12)
    np.testing.assert_allclose(curve, 0.0, atol=1e-11)


@pytest.mark.sweep
def test_where_the_noise_does_not_move_the_pose_nothing_is_infinite():
    factor = graphs.FromMotion(motion.Odometry(np.eye(3)))
    x, still = np.ones(3), np.zeros(3)
    slopes = jax.jit(jax.jacrev(lambda a, b: factor.residual((a, b), still), argnums=(0, 1)))
    assert np.isfinite(slopes(x, x)).all()


def test_a_variable_is_a_pose_or_a_point():
    names = {"measurements": ("x [m]",), "errors": ("x [m]",)}
    with pytest.raises(
        ValueError, match="Own: variables: expected 'pose' and 'point', got 'place'"
    ):
        made(graphs.Factor, variables=("place",), residual=lambda v, z: z, **names)
    with pytest.raises(ValueError, match="Own: residual: expected a method"):
        made(graphs.Factor, variables=("pose",), **names)
    with pytest.raises(ValueError, match="FromSensor: sensor: expected a Sensor, got the class"):
        graphs.FromSensor(sensors.Compass)


def test_a_motion_of_two_noises_is_refused():
    with pytest.raises(ValueError, match=r"3 components.*unicycle with 2: v"):
        graphs.FromMotion(motion.Unicycle(np.eye(2)))


# --- Factors and kernels are records: their numbers are leaves, and derivatives reach them --------


MOUNT = np.array([0.3, -0.2, 0.1])
SEEN = sensors.RelativePosition(np.eye(2), MOUNT)
DRIVEN = motion.Velocity(np.diag([0.1, 0.2, 0.3]))
MADE = {
    **{name: make() for name, make in graphs.KERNELS.items()},
    **graphs.REGISTRY,
    "relative_pose_log": graphs.RelativePoseLog(),
    "from_sensor": graphs.FromSensor(SEEN),
    "from_motion": graphs.FromMotion(DRIVEN),
    "nominal_motion": NominalMotion(motion.Unicycle(np.eye(2))),
}
PARTS = {"from_sensor": SEEN, "from_motion": DRIVEN, "nominal_motion": motion.Unicycle(np.eye(2))}


@pytest.mark.parametrize("name", MADE)
def test_the_numbers_of_a_record_are_its_leaves_and_pickles_keep_them(name):
    made = MADE[name]
    numbers = [made.width] if name in graphs.KERNELS else jax.tree.leaves(PARTS.get(name))
    worlds.assert_record(made, numbers)


TRACED = []


@record
class Counted(sensors.RelativePosition):
    """A sensor that counts how often it is traced."""

    def observe(self, pose, landmark):
        TRACED.append(1)
        return super().observe(pose, landmark)


GRAPH = small_graphs.only(small_graphs.drawn(noise=0.1), "relative_pose", "relative_position")
WIDE = graphs.Huber(50.0)


def factors_of(mount):
    return graphs.REGISTRY | {"relative_position": graphs.FromSensor(Counted(np.eye(2), mount))}


def optimum(mount, width):
    kernel = {"relative_pose": graphs.Cauchy(width)}
    return graphs.optimize(GRAPH, factors_of(mount), kernel=kernel, tolerance=0.0)


def test_other_numbers_of_factor_and_kernel_cost_no_trace_and_no_program():
    first = optimum(MOUNT, 20.0)
    with worlds.nothing_compiled(TRACED):
        second = optimum(2 * MOUNT, 30.0)
    assert not np.allclose(first.graph.poses, second.graph.poses)


@pytest.mark.sweep
def test_derivatives_by_mount_and_width_are_differences():
    """Of a graph that is no tracer itself, so that it is planned and padded as outside a trace."""

    def seen(mount, width):
        solution = optimum(mount, width)
        return solution.graph.poses[:, :2].sum() + solution.graph.points[0, 1] + 0.1 * solution.chi2

    by_mount, by_width = jax.jit(jax.grad(seen, (0, 1)))(MOUNT, 20.0)
    h = 1e-5
    moved = [(seen(MOUNT + h * e, 20.0) - seen(MOUNT - h * e, 20.0)) / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose(by_mount, moved, rtol=1e-5)
    wider = (seen(MOUNT, 20.0 + 1e-2) - seen(MOUNT, 20.0 - 1e-2)) / 2e-2
    np.testing.assert_allclose(by_width, wider, rtol=1e-4)
    assert np.all(by_mount != 0) and by_width != 0


def test_a_gradient_by_a_factor_is_a_factor():
    factor = graphs.FromSensor(SEEN)
    pose, point, z = np.array([1.0, 2.0, 0.5]), np.array([4.0, 3.0]), np.array([2.0, 1.0])
    slope = jax.jit(jax.grad(lambda f: (f.residual((pose, point), z) ** 2).sum()))(factor)
    assert type(slope) is graphs.FromSensor and type(slope.sensor) is sensors.RelativePosition
    assert np.all(slope.sensor.mount != 0) and np.all(slope.sensor.noise_cov.cov == 0)
    slope_of_kernel = jax.grad(lambda kernel: kernel.cost(jnp.asarray(9.0)))(graphs.Huber(2.0))
    np.testing.assert_allclose(slope_of_kernel.width, 2 * 3 - 2 * 2)  # of 2 k √s - k²


@pytest.mark.sweep
def test_a_graph_within_a_trace_is_solved_as_outside():
    graph = ring()
    outside = graphs.optimize(graph)

    @jax.jit
    def within():
        solution = graphs.optimize(graph)
        return solution, graphs.squared_residuals(solution.graph), graphs.squared_residuals(graph)

    solution, squared, before = within()
    np.testing.assert_allclose(solution.graph.poses, outside.graph.poses, atol=1e-9)
    np.testing.assert_allclose(squared["relative_pose"].sum(), outside.chi2, rtol=1e-9)
    np.testing.assert_allclose(before["relative_pose"].sum(), graphs.chi2(graph), rtol=1e-9)
    assert solution.singular == -1 and solution.graph.poses.shape == graph.poses.shape


def test_one_model_for_a_batch():
    plan = graphs.plan(GRAPH)
    widths = jnp.array([1.0, 2.0])
    with pytest.raises(
        ValueError, match=r"^graphs\.optimize: graphs: expected the same factors, kernels, plan and"
    ):
        jax.vmap(lambda k: graphs.optimize(GRAPH, plan=plan, kernel=graphs.Huber(k)))(widths)


def test_numbers_in_float64_leave_a_graph_in_float32():
    numbers = worlds.narrow(GRAPH)
    for name in ("cauchy", "truncated"):
        kernel = dataclasses.replace(graphs.KERNELS[name](), width=np.float64(3.0))
        plan = graphs.plan(GRAPH)
        solution = jax.eval_shape(
            lambda graph, kernel, plan=plan: graphs.optimize(graph, kernel=kernel, plan=plan),
            numbers,
            kernel,
        )
        assert {leaf.dtype for leaf in jax.tree.leaves(solution)}.isdisjoint({np.dtype("f8")})


# --- Robust kernels: their own equations, and what they leave out ---------------------------------


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


@pytest.mark.parametrize("name", swept(["dcs", "truncated"], "truncated"))
def test_a_redescending_kernel_leaves_false_loop_closures_out(name):
    graph, clean = falsified(ring())
    poses, _, information, _ = dense(clean)
    kernel = graphs.KERNELS[name]()
    solution = graphs.optimize(graph, kernel={"relative_pose/loops": kernel})
    s = graphs.squared_residuals(solution.graph)["relative_pose/loops"]
    weights = np.asarray(solution.weights["relative_pose/loops"])
    np.testing.assert_allclose(weights, kernel.weight(s), rtol=1e-9)
    assert solution.status == Ending.CONVERGED
    assert (weights[:2] < 1e-3).all() and (solution.weights["relative_pose"] == 1).all()
    if name == "truncated":  # binary: the others' own optimum
        assert (weights[2:] == 1).all()
        np.testing.assert_allclose(solution.graph.poses[:, :2], poses[:, :2], atol=1e-6)
        # The covariance is that without the false ones; they would make it smaller.
        cov = np.linalg.inv(information)[-3:, -3:]
        np.testing.assert_allclose(graphs.marginals(solution).poses[-1], cov, rtol=1e-5, atol=1e-9)
        with pytest.raises(ValueError, match=r"expected a Solution.* got a Graph; of a graph as"):
            graphs.marginals(solution.graph)


def test_the_robust_start_is_good_and_is_kept():
    """Three loops of seven are false; NumPy has the optimum without them."""
    graph, clean = falsified(ring(spread=0.2), ((2, 12), (6, 15), (1, 9)))
    poses = dense(clean)[0]
    start = graphs.starts.robust(graph)
    off = np.asarray(graphs.starts.odometry(graph).poses)[:, :2] - poses[:, :2]
    left = start.poses[:, :2] - poses[:, :2]
    assert np.abs(left).max() < 0.2 * np.abs(off).max() and start.tables is graph.tables
    solution = graphs.optimize(start, kernel={"relative_pose/loops": graphs.Truncated()})
    np.testing.assert_allclose(solution.graph.poses[:, :2], poses[:, :2], atol=1e-6)
    assert solution.iterations < 10  # weights of zero and one at once, without rounds


@pytest.mark.sweep
@pytest.mark.parametrize(("name", "share"), [("huber", 0.5), ("cauchy", 0.1)])
def test_other_kernels_reduce_the_pull_of_false_loop_closures(name, share):
    """The optimum lies nearer to that without false ones than least squares does, in NumPy."""
    graph, clean = falsified(ring())
    both = Table(*map(np.concatenate, zip(*graph.tables.values(), strict=True)))
    plain = dense(clean._replace(tables={"relative_pose": both}))[0]
    solution = graphs.optimize(graph, kernel={"relative_pose/loops": graphs.KERNELS[name]()})
    best = dense(clean)[0]
    assert solution.status == Ending.CONVERGED
    pulled, free = (
        np.sqrt(((poses[:, :2] - best[:, :2]) ** 2).sum(axis=1).mean())
        for poses in (plain, np.asarray(solution.graph.poses))
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
            ValueError, match=f"^{graphs.KERNELS[name].__name__}: width: expected a number above 0"
        ):
            graphs.KERNELS[name](width)
