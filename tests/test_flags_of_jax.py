"""Models, filters and campaigns of the library under the flags of JAX that find mistakes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_graphs
from cases import swept
from pose_rings import ring
from ring_of_rooms import FAR, SETTINGS, driven

import jaxslam
from jaxslam import catalog, graphs, grids, laser_slam, matching, motion, sensors, topology
from jaxslam.consistency.campaign._block_programs import drive_run
from jaxslam.core.protocols import Sensor
from jaxslam.core.types import Beams
from jaxslam.graphs import smoothing, starts
from jaxslam.laser.matching import IcpSettings, covariance
from jaxslam.simulation import laser
from jaxslam.simulation.scenarios import SCENARIOS, office
from jaxslam.simulation.walls import make_walls, rasterize
from jaxslam.verify import build

KEY = jax.random.key(0)


@pytest.fixture
def strict():
    """JAX promotes no dtypes, as users have it who look for an accidental float64."""
    with jax.numpy_dtype_promotion("strict"):
        yield


def traced(*functions_and_arguments):
    for function, *arguments in functions_and_arguments:
        if function is not None:
            jax.eval_shape(function, *arguments)


@pytest.mark.parametrize("name", catalog.ALL)
@pytest.mark.parametrize("dtype", swept(("float64", "float32"), "float64"))
def test_no_filter_promotes_dtypes(strict, name, dtype):
    with jax.enable_x64(dtype == "float64"):
        world = SCENARIOS["circle"](3)
        truth, log = jax.eval_shape(lambda key: jaxslam.simulate(world, key), KEY)

        def estimated(truth, log):
            return drive_run(world, catalog.ALL[name](world), KEY, 0, truth, log)

        traced((estimated, truth, log))
        assert truth.pose.dtype == dtype


@pytest.mark.parametrize("name", SCENARIOS)
def test_no_scenario_promotes_dtypes(strict, name):
    traced((lambda key: jaxslam.simulate(SCENARIOS[name](3), key), KEY))


@pytest.mark.parametrize("name", [*sensors.REGISTRY, *motion.REGISTRY])
@pytest.mark.parametrize("dtype", swept((np.float64, np.float32), np.float64))
def test_no_model_promotes_dtypes(strict, name, dtype):
    model = build((sensors.REGISTRY | motion.REGISTRY)[name])
    if isinstance(model, Sensor):
        pose = jnp.ones(3 + len(model.robot), dtype)
        sizes = len(model.landmark), len(model.measurements), len(model.free.mean)
        landmark, z, s = (jnp.ones(size, dtype) for size in sizes)
        traced(
            (jax.jacfwd(model.observe, argnums=(0, 1)), pose, landmark),
            (jax.jacfwd(model.invert, argnums=(0, 1)), pose, z, s),
            (model.residual, z, z),
            (model.noise_cov, z),
            (model.embed, pose[:3], pose[:2]),
            (model.position, landmark),
            (model.move_landmark, pose[:3], landmark),
            (model.observe_jacobians, pose, landmark),
            (model.invert_jacobians, pose, z, s),
        )
    else:
        pose = jnp.ones(len(model.state), dtype)
        u, w = (jnp.ones(len(names), dtype) for names in (model.controls, model.noises))
        traced(
            (jax.jacfwd(model.step, argnums=(0, 1, 2)), pose, u, w),
            (model.noise_cov, pose, u),
            (model.jacobians, pose, u, w),
            (model.perturb, u, w),
        )


def test_a_campaign_runs_without_promotion_and_with_guarded_transfers(strict):
    world = SCENARIOS["circle"](3)
    filters = {name: catalog.ALL[name](world) for name in ("dead_reckoning", "ideal")}
    wanted = jaxslam.monte_carlo(world, filters, 2, KEY, progress=False)
    with jax.transfer_guard("disallow"):
        truth, log = jaxslam.simulate(world, KEY)
        found = jaxslam.monte_carlo(world, filters, 2, KEY, progress=False)
        trace = jaxslam.run(filters["dead_reckoning"], log, truth.start, np.zeros((3, 3)), KEY)
    assert np.isfinite(trace.estimate.pose).all()
    for name, summary in wanted.filters.items():
        assert found.filters[name].measures == summary.measures


# --- the other rooms: `cast` gives the arrays of a tree one dtype ----------------------------------

ROOM = make_walls([[0, 0], [5, 0], [5, 2], [3, 2], [3, 3], [0, 3]])
"""Corners [m] of a room in the shape of an L."""
ALONG = np.array([1.5, 1.2, 0.3])
"""A pose in it."""
MOVE = motion.Unicycle(0.01 * np.eye(2))


def of_graphs(cast):
    """Factors, kernels, optima with derivatives and in batches, marginals, certificates."""
    graph = cast(small_graphs.drawn(noise=0.1))
    relative = small_graphs.only(graph, "relative_pose", "relative_position")
    plan = graphs.plan(graph, marginals=True, pairs=[[1, 9]])
    yield graphs.optimize(graph), graphs.squared_residuals(graph)
    for kernel in (None, *(kind() for kind in graphs.KERNELS.values())):
        solution = graphs.optimize(graph, plan=plan, kernel=kernel)
        yield graphs.marginals(solution, plan=plan), graphs.chi2(graph, kernel=kernel)
    many = jax.tree.map(lambda x: np.stack([x] * 17), graph)
    yield jax.vmap(lambda graph: graphs.optimize(graph, plan=plan))(many)
    yield graphs.certificate(relative)
    log_error = {"relative_pose": graphs.RelativePoseLog()}
    yield graphs.optimize(cast(ring()), log_error)

    def optimum(z):
        table = graph.tables["relative_pose"]._replace(z=z)
        given = graph._replace(tables=graph.tables | {"relative_pose": table})
        return graphs.optimize(given, plan=plan).graph.poses

    yield jax.jacfwd(optimum)(graph.tables["relative_pose"].z)


def of_smoothing(cast):
    """Estimators of a whole log, and its graph."""
    world = SCENARIOS["circle"](3)
    models, start = (world.motion, world.sensor), cast((world.pose, world.pose_cov))
    _, log = jaxslam.simulate(world, KEY)
    log = cast(log)
    for estimator in (smoothing.Smoother, smoothing.BatchMap):
        yield estimator(*models, 20, *start)(log, KEY)
    graph, factors = graphs.of_log(log, *models, *start, slack=1e-3, capacity=20)
    yield jax.vmap(lambda graph: graphs.chi2(graph, factors))(
        jax.tree.map(lambda x: x[None], graph)
    )


def of_grids(cast):
    """Maps from scans, distances, rays, beam models and localization."""
    grid, poses, angles = cast(
        (rasterize(ROOM, 0.2), np.stack([ALONG] * 4), np.linspace(-3, 3, 12))
    )
    beams = cast(Beams(np.ones((4, 12)), np.stack([angles] * 4), np.ones((4, 12), bool)))
    scan = jax.tree.map(lambda part: part[0], beams)
    frame = grid.origin, grid.resolution
    counts = grids.count((20, 30), *frame, poses, beams, max_range=8.0, no_return=4.0)
    for made in (grids.occupancy(counts), grids.reflection(counts)):
        yield grids.entropy(made), grids.centers(made), grids.correlation(made, made)
    yield grids.entropy(grid), grids.centers(grid), grids.correlation(grid, grid)
    field = grids.distance_field(grid, truncate=1.0)
    yield grids.gradient(field), grids.resample(grid, 0.4), grids.crop(grid, [0.5, 0.5], [2.0, 2.0])
    yield jax.grad(lambda points: grids.interpolate(field, points).sum())(poses[:, :2])
    for method in ("surface", "cells"):
        rays = grids.ray_map(grid, method=method)
        yield grids.cast(rays, poses, angles, 8.0)
        yield jax.jacfwd(lambda pose, rays=rays: grids.cast(rays, pose, angles, 8.0))(poses[0])
    log = grids.beam_log(cast(np.tile([0.2, 0.3, 0.25], (4, 1))), beams)
    for model in (grids.LikelihoodField(max_range=8.0), grids.RayCast(max_range=8.0)):
        prepared = model.prepare(grid)
        yield grids.log_likelihood(model, prepared, poses[0], scan)
        yield model.jacobian(prepared, poses[0], scan)
        filter = grids.GridLocalization(grid, model, MOVE, 50)
        yield jaxslam.run(filter, log, *cast((ALONG, np.eye(3))), KEY)


def of_matching(cast):
    """Matchers, with a prior and without one, and covariances of a match."""
    beams = cast(driven(scans=2)[1].beams)
    reference, scan = (
        matching.points(Beams(*(part[k] for part in beams)), FAR, mount=(0.1, 0.0, 0.0))
        for k in (0, 1)
    )
    start, information = cast((np.array([1.0, 0.0, 0.0]), np.eye(3)))
    settings = IcpSettings(kernel=graphs.Huber(), trim=0.9, lone=0.5)
    lines = matching.PointToLine(settings)
    for matcher in (
        matching.PointToPoint(),
        lines,
        matching.FieldMatcher(kernel=graphs.Cauchy()),
        matching.Correlative(turn_window=0.1),
    ):
        given = matching.raster(reference, 0.05, 4.0) if matcher.of_grid else reference
        prepared = matcher.prepare(given)
        for prior in (None, matching.Prior(start, information)):
            found = matching.match(matcher, given, scan, start, prior)
            yield found, jax.grad(matcher.cost, argnums=2)(prepared, scan, start, found)
    found = matching.match(lines, reference, scan, start)
    for way in (
        covariance.Hessian(),
        covariance.Implicit(0.03),
        covariance.AlongNormals(0.03),
        covariance.Lattice(0.03, steps=3),
        covariance.Unscented(0.03, 0.01 * np.eye(3)),
        covariance.Sampling(0.03, 0.01 * np.eye(3), 2),
    ):
        yield covariance.covariance(way, lines, reference, scan, found, start, KEY)


def of_laser(cast):
    """Scans of a room."""
    scanner = laser.Laser(cast(np.linspace(-3, 3, 12)), dropout=0.1)
    controls = cast(np.ones((3, 3)))
    yield laser.scan_world(laser.LaserWorld("room", ROOM, scanner, MOVE, controls, ALONG), KEY)


ROOMS = {
    "graphs": of_graphs,
    "smoothing": of_smoothing,
    "grids": of_grids,
    "matching": of_matching,
    "laser": of_laser,
}
PRECISIONS = pytest.mark.parametrize(
    ("x64", "dtype"),
    swept([(True, np.float64), (False, np.float32), (True, np.float32)], (True, np.float64)),
)


def caster(dtype):
    """A function of a tree that gives its real numbers a dtype."""
    return lambda tree: jax.tree.map(lambda x: x.astype(dtype) if x.dtype.kind == "f" else x, tree)


@pytest.mark.parametrize("room", ROOMS)
@PRECISIONS
def test_no_room_promotes_dtypes(strict, room, x64, dtype):
    with jax.enable_x64(x64):
        traced((lambda: list(ROOMS[room](caster(dtype))),))


# Not of float32 arrays under x64: the host makes a frame in float64 beside them.
@pytest.mark.parametrize("dtype", swept(("float64", "float32"), "float64"))
def test_nothing_on_the_host_promotes_dtypes(strict, dtype):
    """Topology, starts of graphs, fits, clusters and what a scan says of a pose."""
    cast = caster(dtype)
    with jax.enable_x64(dtype == "float64"):
        places = topology.topological_map(cast(rasterize(office().walls, 0.1)))
        way = topology.route(places, [1.8, 1.5], [9.6, 6.6])
        weights, lost = topology.place_weights(places, *cast((ALONG[None], np.zeros(1))))
        assert len(way.places) == 3 and weights.sum() == 1 and lost == 0
        graph = small_graphs.only(cast(small_graphs.drawn()), "relative_pose", "relative_position")
        for start in starts.STARTS.values():
            np.testing.assert_allclose(start(graph).poses, graph.poses, atol=1e-4)
        ranges = cast(np.array([1.0, 2.0, 8.0]))
        assert np.isfinite(grids.fit(ranges, ranges, 8.0, iterations=2)).all()
        assert len(grids.clusters(*cast((ALONG[None], np.zeros(1)))).weight) == 1
        scanner = laser.Laser(cast(np.linspace(-3, 3, 12)))
        assert not laser.scan_information(scanner, ROOM, cast(ALONG)).names


@pytest.mark.sweep
@pytest.mark.parametrize("x64", [True, False])
def test_laser_slam_promotes_no_dtypes(strict, x64):
    """From the log, which is of NumPy, to the map and the covariances."""
    _, log = driven()
    with jax.enable_x64(x64):
        solved = laser_slam.solve(log, SETTINGS)
    assert np.isfinite(solved.poses).all() and np.isfinite(solved.cov).all()
