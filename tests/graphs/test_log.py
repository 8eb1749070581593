"""The graph of a log: the optimum of `batch_map`, that of SciPy, and what is refused."""

import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import worlds
from cases import refused, swept
from reference import ekf_slam, plane

from jaxslam import graphs, motion, sensors, simulate
from jaxslam.core.record import record
from jaxslam.core.types import Log, Scan
from jaxslam.graphs import Ending
from jaxslam.graphs.smoothing import BatchMap

KEY = jax.random.key(0)
STEPS = 8
SIGMA_W, SIGMA_Z = np.array([0.02, 0.03, 0.02]), np.array([0.05, 0.02])
START, START_COV = (
    (0.2, -0.1, 0.7),
    np.array([[0.02, 0.01, 0.0], [0.01, 0.03, 0.002], [0, 0.002, 0.01]]),
)


def small_world():
    """Turning robot among six posts; a noise that bends (odometry), and P0 that is not diagonal."""
    return dataclasses.replace(
        worlds.ring(),
        motion=motion.Odometry(np.diag(SIGMA_W) ** 2),
        sensor=sensors.RangeBearing(np.diag(SIGMA_Z) ** 2),
        controls=np.tile([0.2, 0.6, 0.2], (STEPS, 1)),
        pose=START,
        pose_cov=START_COV,
    )


@cache
def drawn():
    """The world and a log of it."""
    return small_world(), jax.device_get(simulate(small_world(), KEY)[1])


@cache
def solved(known=False):
    """World, log, graph, factors and solution; known: the start is."""
    world, log = drawn()
    cov = np.zeros((3, 3)) if known else START_COV
    graph, factors = graphs.of_log(log, world.motion, world.sensor, START, cov)
    solution = graphs.optimize(graph, factors, tolerance=1e-16)
    return world, log, jax.device_get(graph), factors, solution


def turned(pose, u):
    """`motion.Odometry`, from its equation."""
    h = pose[2] + u[0]
    return np.array([pose[0] + u[1] * np.cos(h), pose[1] + u[1] * np.sin(h), h + u[2]])


def optimum(log, points, step, sigma_w, start, root=None, sigma_z=lambda z: SIGMA_Z):
    """(cost, poses, points) by SciPy over noises and points, as in the batch, but from the equations
    in NumPy; root: of the covariance of the start, which else is known. sigma_z: of a measurement,
    by its prediction at the last optimum, until that stays."""
    free, size = 0 if root is None else 3, len(sigma_w)
    ends = free, free + STEPS * size

    def path(x):
        poses = [start if root is None else start + root @ x[:3]]
        for u, w in zip(log.control, x[ends[0] : ends[1]].reshape(-1, size), strict=True):
            poses.append(step(poses[-1], u + sigma_w * w))
        return poses

    def predictions(x):
        points = x[ends[1] :].reshape(-1, 2)
        for pose, *scan in zip(path(x)[1:], *log.scan, strict=True):
            for z, tag, is_valid in zip(*scan, strict=True):
                if is_valid:
                    yield z, ekf_slam.range_bearing(pose, points[tag])[0]

    def residuals(x, sigmas):
        out = [x[: ends[1]]]
        for (z, z_hat), sigma in zip(predictions(x), sigmas, strict=True):
            off = z - z_hat
            out.append(np.array([off[0], plane.wrap(off[1])]) / sigma)
        return np.concatenate(out)

    at = np.concatenate([np.zeros(ends[1]), points.ravel()])
    ending = {"ftol": 1e-15, "xtol": 1e-15, "gtol": 1e-12}
    sigmas, before = [sigma_z(z_hat) for _, z_hat in predictions(at)], None
    while before is None or np.abs(np.subtract(sigmas, before)).max() > 1e-10:
        fit = scipy.optimize.least_squares(residuals, at, "3-point", args=(sigmas,), **ending)
        at, before = fit.x, sigmas
        sigmas = [sigma_z(z_hat) for _, z_hat in predictions(at)]
    return fit.cost, np.array(path(fit.x)), fit.x[ends[1] :].reshape(-1, 2)


@pytest.mark.parametrize("known", swept([False, True], False))
def test_it_has_the_optimum_of_scipy(known):
    _, log, graph, _, solution = solved(known)
    assert solution.status == Ending.CONVERGED
    assert list(graph.tables) == ["motion", *["prior"] * (not known), "sensor"]
    root = None if known else np.linalg.cholesky(START_COV)
    cost, poses, points = optimum(log, graph.points, turned, SIGMA_W, np.array(START), root)
    np.testing.assert_allclose(solution.chi2, 2 * cost, rtol=1e-10)
    np.testing.assert_allclose(solution.graph.points, points, atol=1e-6)
    off = solution.graph.poses - poses
    np.testing.assert_allclose(off[:, :2], 0, atol=1e-6)
    np.testing.assert_allclose(plane.wrap(off[:, 2]), 0, atol=1e-6)
    if known:
        np.testing.assert_array_equal(solution.graph.poses[0], START)


@pytest.mark.sweep
@pytest.mark.parametrize("known", [False, True])
def test_it_has_the_optimum_of_batch_map(known):
    world, log, graph, _, solution = solved(known)
    cov = np.zeros((3, 3)) if known else START_COV
    trace = BatchMap(world.motion, world.sensor, 6, START, cov, tolerance=1e-9)(log, KEY)
    batch = trace.final
    assert batch.ending == Ending.CONVERGED
    np.testing.assert_allclose(solution.chi2, 2 * batch.cost, rtol=1e-8)
    off = np.asarray(solution.graph.poses) - [batch.start, *trace.estimate.pose]
    off[:, 2] = plane.wrap(off[:, 2])
    np.testing.assert_allclose(off, 0, atol=1e-8)
    assert set(batch.joint.tag.tolist()) == set(graph.point_id.tolist())
    order = np.searchsorted(graph.point_id, batch.joint.tag)
    np.testing.assert_allclose(batch.joint.landmarks, solution.graph.points[order], atol=1e-8)


GROWING = {"range": 0.02, "bearing": 0.02, "share": 0.15}


@cache
def grown():
    """World, log, graph, factors and solution, with a noise that grows with the range."""
    noise = sensors.RangeBearingNoise(**GROWING)
    world = dataclasses.replace(small_world(), sensor=sensors.RangeBearing(noise))
    log = jax.device_get(simulate(world, KEY)[1])
    graph, factors = graphs.of_log(log, world.motion, world.sensor, START, START_COV)
    return world, log, graph, factors, graphs.optimize(graph, factors, tolerance=1e-16)


def test_a_noise_that_grows_is_that_of_the_predictions():
    """The optimum by SciPy with R of the predictions held, and repeated until it stays. χ² of the
    batch and its path are the same; R at the measurements has another optimum."""
    world, log, graph, factors, solution = grown()
    assert solution.status == Ending.CONVERGED

    def sigma_z(z):
        return np.array([np.hypot(GROWING["range"], GROWING["share"] * z[0]), GROWING["bearing"]])

    root = np.linalg.cholesky(START_COV)
    start = log, np.asarray(graph.points), turned, SIGMA_W, np.array(START), root
    cost, poses, points = optimum(*start, sigma_z)
    np.testing.assert_allclose(solution.graph.points, points, atol=1e-6)
    off = np.asarray(solution.graph.poses) - poses
    np.testing.assert_allclose(np.c_[off[:, :2], plane.wrap(off[:, 2])], 0, atol=1e-6)
    np.testing.assert_allclose(solution.chi2, 2 * cost, rtol=1e-8)
    np.testing.assert_allclose(graphs.chi2(solution.graph, factors), 2 * cost, rtol=1e-8)
    squares = graphs.squared_residuals(solution.graph, factors)
    np.testing.assert_allclose(sum(map(np.sum, squares.values())), 2 * cost, rtol=1e-8)

    trace = BatchMap(world.motion, world.sensor, 6, START, START_COV, tolerance=1e-9)(log, KEY)
    assert trace.final.ending == Ending.CONVERGED
    np.testing.assert_allclose(2 * trace.final.cost, solution.chi2, rtol=1e-8)
    np.testing.assert_allclose(trace.estimate.pose[:, :2], poses[1:, :2], atol=1e-6)
    covs = graphs.marginals(solution, factors).poses
    np.testing.assert_allclose(covs[1:], trace.estimate.pose_cov, rtol=0, atol=1e-7)


@record
class Gap:
    """A noise that is singular at one range."""

    at: float

    def __call__(self, z):
        return jnp.diag(SIGMA_Z**2) * (jnp.abs(z[0] - self.at) > 1e-6)


def test_a_noise_is_refused_where_it_is_singular_at_a_prediction_and_not_at_a_measurement():
    world, log = drawn()

    def graph_with(at):
        sensor = sensors.RangeBearing(Gap(at))
        return graphs.of_log(log, world.motion, sensor, START, START_COV)[0]

    graph = graph_with(1e3)
    (pose, point), z = graph.tables["sensor"].who[-1], graph.tables["sensor"].z[-1, 0]
    offset = np.asarray(graph.points)[point] - np.asarray(graph.poses)[pose, :2]
    assert graph.tables["sensor"].valid[-1] and abs(np.hypot(*offset) - z) > 1e-3
    graph_with(float(z))
    with pytest.raises(ValueError, match=f"range_bearing is singular at row {pose - 1}"):
        graph_with(float(np.hypot(*offset)))


@pytest.mark.sweep
def test_derivatives_where_the_noise_grows_are_differences():
    world, log, graph, factors, _ = grown()
    plan, random = graphs.plan(graph, factors), np.random.default_rng(2)
    look = random.normal(size=graph.points.shape), random.normal(size=graph.poses.shape)

    def seen(share):
        noise = sensors.RangeBearingNoise(**(GROWING | {"share": share}))
        models = world.motion, sensors.RangeBearing(noise)
        made, by_table = graphs.of_log(log, *models, START, START_COV)
        solution = graphs.optimize(made, by_table, plan=plan, tolerance=1e-16)
        poses, points = solution.graph.poses, solution.graph.points
        return (points * look[0]).sum() + (poses * look[1]).sum() + solution.chi2

    both = jax.jit(jax.value_and_grad(seen))
    ends = [both(0.15 + step)[0] for step in (1e-5, -1e-5)]
    np.testing.assert_allclose(both(0.15)[1], (ends[0] - ends[1]) / 2e-5, rtol=1e-6)


@pytest.mark.sweep
def test_derivatives_of_the_optimum_by_the_noises_are_differences():
    """By Q and R, in factories that the differentiated function calls."""
    _, log, graph, factors, _ = solved()
    plan, random = graphs.plan(graph, factors), np.random.default_rng(2)
    look = random.normal(size=graph.points.shape), random.normal(size=graph.poses.shape)
    covs, tangents = [], []
    for sigma in (SIGMA_W, SIGMA_Z):
        turn = random.normal(size=(len(sigma), len(sigma)))
        covs.append(np.diag(sigma) ** 2)
        tangents.append((turn + turn.T) * np.outer(sigma, sigma) / 4)

    def seen(q, r):
        models = motion.Odometry(q), sensors.RangeBearing(r)
        made, by_table = graphs.of_log(log, *models, START, START_COV)
        solution = graphs.optimize(made, by_table, plan=plan, tolerance=1e-16)
        poses, points = solution.graph.poses, solution.graph.points
        return (points * look[0]).sum() + (poses * look[1]).sum() + solution.chi2

    both = jax.jit(jax.value_and_grad(seen, (0, 1)))
    gradient = both(*covs)[1]
    for k, tangent in enumerate(tangents):
        ends = []
        for step in (1e-4, -1e-4):
            moved = list(covs)
            moved[k] = covs[k] + step * tangent
            ends.append(both(*moved)[0])
        slope = (np.asarray(gradient[k]) * tangent).sum()
        np.testing.assert_allclose(slope, (ends[0] - ends[1]) / 2e-4, rtol=1e-6)


@pytest.mark.sweep
def test_a_motion_of_two_noises_is_a_soft_constraint():
    """The optimum comes to that of the constraint by the square of the slack."""
    world = dataclasses.replace(worlds.ring(STEPS), sensor=small_world().sensor)
    log = jax.device_get(simulate(world, KEY)[1])
    off = []
    for slack in (1e-3, 1e-4):
        models = world.motion, world.sensor, world.pose, np.zeros((3, 3))
        graph, factors = graphs.of_log(log, *models, slack=slack)
        solution = graphs.optimize(graph, factors, tolerance=1e-16)
        if not off:
            step = lambda pose, u: ekf_slam.increment(pose, u)[0]  # noqa: E731
            poses = optimum(log, np.asarray(graph.points), step, [0.01, 0.01], np.zeros(3))[1]
        apart = solution.graph.poses - poses
        off.append(max(np.abs(apart[:, :2]).max(), np.abs(plane.wrap(apart[:, 2])).max()))
    assert off[0] < 1e-3
    assert 0.5 < off[0] / off[1] / 100 < 1.5


def test_more_noises_than_three_are_those_of_their_sum():
    """Of two substeps of a motion without turns, which are affine: e has the covariance of both."""
    single = motion.PoseIncrement(np.diag([0.1, 0.2, 0.3]) ** 2)
    twice = motion.Substeps(single, 2)
    scan = Scan(np.full((1, 1, 1), 0.1), np.full((1, 1), -1), np.ones((1, 1), bool))
    log = Log(np.tile([0.5, 0.0, 0.0], (1, 2)), scan)
    models = twice, sensors.Compass([[0.01]])
    graph, factors = graphs.of_log(log, *models, np.zeros(3), np.zeros((3, 3)))
    by_heading = np.array(
        [[0.0, 0.0, 0.0], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]]
    )  # y by the first turn
    first = np.eye(3) + by_heading
    q = np.diag([0.1, 0.2, 0.3]) ** 2
    expected = np.linalg.inv(first @ q @ first.T + q)
    np.testing.assert_allclose(graph.tables["motion"].information[0], expected, rtol=1e-10)
    assert factors["motion"].errors == ("x [m]", "y [m]", "theta [rad]")


def test_its_shapes_and_names():
    world, log, graph, factors, _ = solved()
    assert list(graph.tables) == ["motion", "prior", "sensor"]
    np.testing.assert_array_equal(graph.pose_id, np.arange(STEPS + 1))
    np.testing.assert_array_equal(graph.point_id, np.unique(log.scan.tag[log.scan.valid]))
    np.testing.assert_array_equal(graph.tables["motion"].z, log.control)
    rows = graph.tables["sensor"]
    np.testing.assert_array_equal(rows.valid, log.scan.valid.ravel())
    np.testing.assert_array_equal(
        graph.point_id[rows.who[rows.valid, 1]], log.scan.tag[log.scan.valid]
    )
    np.testing.assert_allclose(rows.information[0], np.diag(SIGMA_Z**-2.0), rtol=1e-12)
    graphs.check_graph(graph, factors)
    # Each point has no residual at its first measurement.
    squared = np.asarray(graphs.squared_residuals(graph, factors)["sensor"])
    first = np.unique(np.where(rows.valid, rows.who[:, 1], 99), return_index=True)[1][:6]
    np.testing.assert_allclose(squared[first], 0, atol=1e-18)


def test_logs_are_batched_with_a_capacity():
    world, log, graph, _, _ = solved()

    def poses_and_points(z):
        moved = Log(log.control, log.scan._replace(z=z))
        made = graphs.of_log(moved, world.motion, world.sensor, START, START_COV, capacity=7)[0]
        return made.poses, made.points, made.fixed_point

    z = np.stack([log.scan.z, log.scan.z + 0.1])
    poses, points, fixed = jax.jit(jax.vmap(poses_and_points))(z)
    np.testing.assert_allclose(poses[0], graph.poses, atol=1e-14)
    np.testing.assert_allclose(points[0][graph.point_id], graph.points, atol=1e-14)
    assert fixed[0].tolist() == [tag not in graph.point_id for tag in range(7)]
    assert np.abs(points[1][:6] - points[0][:6]).max() > 0.01


@pytest.mark.sweep
def test_points_of_a_capacity_that_no_scan_saw_are_no_hindrance():
    world, log, _, _, solution = solved()
    made = graphs.of_log(log, world.motion, world.sensor, START, START_COV, capacity=9)
    np.testing.assert_allclose(graphs.optimize(*made).chi2, solution.chi2, rtol=1e-9)


def test_an_association_stands_in_for_tags():
    world, log, graph, _, _ = solved()
    unknown = Log(log.control, log.scan._replace(tag=np.full_like(log.scan.tag, -1)))
    tags = np.where(log.scan.tag == 2, -1, log.scan.tag + 10)
    made, _ = graphs.of_log(unknown, world.motion, world.sensor, START, START_COV, tags=tags)
    expected = [tag + 10 for tag in graph.point_id if tag != 2]
    np.testing.assert_array_equal(made.point_id, expected)
    used = log.scan.valid & (log.scan.tag != 2)
    assert int(made.tables["sensor"].valid.sum()) == used.sum()


def test_an_absolute_sensor_has_no_points():
    steps = 3
    scan = Scan(np.full((steps, 1, 1), 0.1), np.full((steps, 1), -1), np.ones((steps, 1), bool))
    log = Log(np.tile([0.5, 0.0, 0.1], (steps, 1)), scan)
    models = motion.PoseIncrement(np.eye(3)), sensors.Compass([[0.01]])
    graph, factors = graphs.of_log(log, *models, np.zeros(3), np.eye(3))
    assert graph.points.shape == (0, 0) and factors["sensor"].variables == ("pose",)
    np.testing.assert_array_equal(graph.tables["sensor"].who, [[1], [2], [3]])


def _log(**change):
    log = drawn()[1]
    return Log(change.pop("control", log.control), log.scan._replace(**change))


@refused(
    (
        {"control": np.ones((STEPS, 2))},
        {"motion": motion.Increment(np.eye(2))},
        r"graphs\.of_log: slack: increment has 2 noises, which do not move the pose",
    ),
    ({}, {"slack": -1.0}, r"graphs\.of_log: slack: expected a finite number >= 0, got -1\.0"),
    ({}, {"motion": motion.Odometry(np.diag([1.0, 0, 1]))}, "odometry is singular at row 0"),
    ({"control": np.tile([0.1, 0, 0.1], (STEPS, 1))}, {}, "all directions at row 0"),
    ({}, {"sensor": sensors.RangeBearing(np.diag([1.0, 0]))}, "range_bearing is singular"),
    (
        {},
        {"pose_cov": np.diag([1.0, 0, 1])},
        r"graphs\.of_log: pose_cov: expected zero, which fixes the first pose, or a",
    ),
    (
        {},
        {"pose": np.zeros(2)},
        r"graphs\.of_log: pose: expected finite numbers of shape \(3,\), got an array",
    ),
    ({}, {"capacity": 3}, r"graphs\.of_log: tags: expected a number below 3, the capacity, got 3"),
    (
        {},
        {"pose": np.full(3, np.nan)},
        r"graphs\.of_log: pose: expected finite numbers of shape \(3,\), got \[nan nan",
    ),
    ({}, {"tags": np.zeros((STEPS, 6))}, r"graphs\.of_log: tags: expected integers, got float64"),
    (
        {},
        {"tags": np.zeros((2, 2), int)},
        r"graphs\.of_log: tags: expected shape \(8, 6\), got \(2, 2\)",
    ),
    ({"tag": np.full((STEPS, 6), -1)}, {}, "has no identity: give tags="),
    ({"valid": np.zeros((STEPS, 6), bool)}, {}, "no measurement of a landmark"),
    (
        {},
        {"sensor": sensors.Suite(((sensors.RangeBearing(np.eye(2)), 6),))},
        r"graphs\.of_log: sensor: expected one of landmarks that stay what they are,",
    ),
)
def test_bad_input_is_refused(change, options):
    world = small_world()
    given = {"motion": world.motion, "sensor": world.sensor, "pose": START, "pose_cov": START_COV}
    given |= options
    models = [given.pop(key) for key in ("motion", "sensor", "pose", "pose_cov")]
    graphs.of_log(_log(**change), *models, **given)
