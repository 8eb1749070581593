"""Localization in a grid: one step in NumPy, the KLD count, a robot carried away, bad input."""

import dataclasses

import jax
import numpy as np
import pytest
from cases import refused

from jaxslam import consistency, grids, motion, run
from jaxslam.core.types import Beams, Scan, Status
from jaxslam.resampling import kld_bound
from jaxslam.simulation.laser import Laser, LaserWorld, scan_world
from jaxslam.simulation.walls import make_walls, rasterize

KEY = jax.random.key(3)
ROOM = make_walls([[0, 0], [5, 0], [5, 2], [3, 2], [3, 3], [0, 3]])  # no two poses look alike
GRID = rasterize(ROOM, 0.1)
FAR = 8.0
MODEL = grids.LikelihoodField(0.1, max_range=FAR)
MOVE = motion.Unicycle(np.diag([0.1, 0.1]) ** 2)
CONTROLS = np.tile([0.2, 0.3, 0.25], (60, 1))
WORLD = LaserWorld(
    name="room",
    walls=ROOM,
    laser=Laser(np.linspace(-3, 3, 24), sigma=0.02, max_range=FAR),
    motion=MOVE,
    controls=CONTROLS,
    pose=(1.5, 1.2, 0.0),
)
PARTICLES = 200
EXACT = np.zeros((3, 3))


def of(count=PARTICLES, **options):
    return grids.GridLocalization(GRID, MODEL, MOVE, count, **options)


def kept(state):
    return state.pose, state.log_weight


@pytest.fixture(scope="module")
def history():
    log = jax.device_get(scan_world(WORLD, jax.random.key(0)))
    return log, grids.beam_log(log.control, log.beams)


CAPACITY = 800


@pytest.fixture(scope="module")
def lost(history):
    """Eight runs that are told a wrong place, with recovery and, by equal rates, without: one program."""
    truth, log = history

    def go(key, slow):
        filter = of(CAPACITY, exponent=0.2, forget=(slow, 0.5))
        return run(filter, log, np.array([4.2, 1.0, 2.5]), 0.01 * np.eye(3), key, probe=kept)

    program = jax.jit(jax.vmap(go, (0, None)))
    keys = jax.random.split(KEY, 8)
    return truth.pose, *(jax.device_get(program(keys, slow)) for slow in (0.02, 0.5))


def reference_misfit(pose, scan, field):
    """-Σ log p of one pose, beam by beam."""
    total = 0.0
    for (r, angle), valid in zip(scan.z, scan.valid, strict=True):
        if not valid or r >= FAR:
            continue
        h = pose[2] + angle
        end = np.array([pose[0] + r * np.cos(h), pose[1] + r * np.sin(h)])
        d = float(grids.interpolate(field, end))
        normal = np.exp(-0.5 * (d / 0.1) ** 2) / (0.1 * np.sqrt(2 * np.pi))
        total -= np.log(0.9 * normal + 0.1 / FAR)
    return total


def test_one_update_weighs_the_particles_as_numpy_does(history):
    _, log = history
    scan = Scan(*(part[5].copy() for part in log.scan))
    scan.valid[3] = False
    filter = of(6, exponent=0.3, least=6)
    state = filter.init(np.array([1.9, 1.3, 0.4]), np.diag([0.2, 0.2, 0.2]) ** 2)
    update = jax.jit(filter.update)
    state, _ = update(state, scan, KEY)  # draws the start
    prior = np.log([0.3, 0.2, 0.2, 0.1, 0.1, 0.1])
    poses = np.array(state.pose)
    poses[4], poses[5] = [4.0, 2.6, 0.0], [90.0, 0.0, 0.0]  # in a wall, and off the map
    state, info = update(state._replace(pose=poses, log_weight=prior), scan, KEY)
    field = grids.distance_field(GRID, truncate=2.0)
    misfit = np.array([reference_misfit(pose, scan, field) for pose in poses[:4]])
    weight = np.exp(prior[:4] - 0.3 * misfit)
    np.testing.assert_allclose(np.exp(state.log_weight[:4]), weight / weight.sum(), rtol=1e-9)
    assert np.all(np.asarray(state.log_weight[4:]) == -np.inf)
    assert float(info.log_likelihood) == pytest.approx(np.log(weight.sum()))
    found = info.extra["particles"]
    assert int(found.blocked) == 2
    assert float(found.ess) == pytest.approx(weight.sum() ** 2 / (weight**2).sum())
    status = np.asarray(info.status)
    assert status[3] == Status.EMPTY and np.all(np.delete(status, 3) == Status.FUSED)
    # The geometric mean of a beam, over the particles: what recovery averages.
    each = np.exp(-misfit / scan.valid.sum())
    before = float(update(filter.init(poses[0], EXACT), scan, KEY)[0].slow)
    np.testing.assert_allclose(before, each[0], rtol=1e-9)


def test_a_scan_without_a_beam_changes_no_weight_and_every_takes_each_nth(history):
    _, log = history
    filter = of(4, stride=5, least=4)
    start = filter.init(np.array([1.5, 1.2, 0.0]), 0.01 * np.eye(3))
    update = jax.jit(filter.update)
    scan = Scan(*(part[0].copy() for part in log.scan))
    state, info = update(start, scan, KEY)
    wanted = np.where(np.arange(24) % 5 == 0, Status.FUSED, Status.UNMATCHED)
    np.testing.assert_array_equal(info.status, np.where(scan.valid, wanted, Status.EMPTY))
    after, info = update(state, scan._replace(valid=np.zeros(24, bool)), KEY)
    np.testing.assert_allclose(after.log_weight, state.log_weight, atol=1e-12)
    assert float(after.slow) == float(state.slow) and float(info.log_likelihood) == pytest.approx(0)


def test_a_lost_robot_is_found_by_particles_from_anywhere(lost):
    true, *traces = lost
    found = []
    for trace in traces:
        error = np.hypot(*np.moveaxis((trace.estimate.pose - true)[:, -1, :2], -1, 0))
        found.append((error < 0.2).sum())
    assert found[0] >= 4 and found[1] == 0
    assert traces[0].info.extra["particles"].injected.any(axis=1).all()
    assert not traces[1].info.extra["particles"].injected.any()


def test_particles_of_no_weight_from_the_start_are_drawn_anew_until_one_has_some():
    filter = of(16, least=16)
    update, predict = jax.jit(filter.update), jax.jit(filter.predict)
    state = filter.init(np.array([50.0, 50.0, 0.0]), EXACT)
    scan = Scan(np.column_stack([np.ones(4), np.zeros(4)]), np.full(4, -1), np.zeros(4, bool))
    nothing = update(state, scan, KEY)[0]
    assert float(nothing.injection) == 0.0  # no beam, no verdict
    np.testing.assert_allclose(nothing.log_weight, state.log_weight, atol=1e-12)
    state, info = update(state, scan._replace(valid=np.ones(4, bool)), KEY)
    assert info.extra["particles"].underflow and float(state.injection) == 1.0
    assert np.all(info.status == Status.UNMATCHED)
    state, info = update(
        predict(state, CONTROLS[0], KEY), scan._replace(valid=np.ones(4, bool)), KEY
    )
    found = info.extra["particles"]
    assert int(found.injected) == 16 and not found.underflow and float(state.injection) == 0.0


@pytest.mark.sweep
def test_the_ray_cast_model_keeps_the_robot_on_the_draws_that_both_models_get():
    """From a pose known roughly, 20 steps: same truths for both, and both stay within 0.15 m."""
    world = dataclasses.replace(WORLD, controls=CONTROLS[:20])
    ray_cast = grids.RayCast(max_range=FAR, method="cells")
    truths = []
    for model, count in ((MODEL, 200), (ray_cast, 150)):
        filter = grids.GridLocalization(GRID, model, MOVE, count, exponent=0.2)
        scores = consistency.judge_localization(
            world, filter, 2, KEY, start_cov=np.diag([0.1, 0.1, 0.05]) ** 2, stride=5
        )
        error = np.asarray(scores.pose - scores.truth)[:, 1:]
        assert np.hypot(error[..., 0], error[..., 1]).max() < 0.15
        truths.append(np.asarray(scores.truth))
    np.testing.assert_array_equal(*truths)


def test_the_number_is_that_of_the_kld_bound(lost):
    """After a motion that resampled: the first particles that reach the bound of their bins."""
    used = lost[2].info.extra["particles"]
    for step in (1, 30):
        assert used.resampled[0, step]
        pose = lost[2].probe[0][0, step]
        at = np.floor((pose + [0, 0, np.pi]) / [0.5, 0.5, np.radians(15)]).astype(int)
        occupied = np.array([len(np.unique(at[: m + 1], axis=0)) for m in range(CAPACITY)])
        fits = np.arange(1, CAPACITY + 1) >= np.maximum(50, kld_bound(occupied, 0.05, 0.99))
        assert fits.any() and used.active[0, step] == 1 + np.argmax(fits)


def test_clusters_are_the_groups_of_bins_that_touch():
    rng = np.random.default_rng(0)
    means = np.array([[1.0, 1.0, np.pi], [4.0, 2.0, 0.3]])
    which = np.repeat([0, 1], [120, 80])
    pose = means[which] + rng.uniform(-0.2, 0.2, (200, 3))
    pose[:, 2] = np.angle(np.exp(1j * pose[:, 2]))  # the first is on the seam
    weight = np.where(which == 0, 1.0, 3.0)
    log_weight = np.log(weight / weight.sum())
    log_weight[7] = -np.inf
    found = grids.clusters(pose, log_weight)
    np.testing.assert_allclose(found.weight, np.array([240, 119]) / 359, rtol=1e-6)
    np.testing.assert_array_equal(found.size, [80, 119])
    assert found.label[7] == -1 and found.label[0] == 1 and found.label[150] == 0
    off = found.mean - means[::-1]
    off[:, 2] = np.angle(np.exp(1j * off[:, 2]))
    assert np.abs(off).max() < 0.05
    np.testing.assert_allclose(found.cov[0], np.cov(pose[120:].T), rtol=0.03, atol=1e-4)
    assert len(grids.clusters(pose, log_weight, least=0.5).weight) == 1


def test_a_start_anywhere_is_in_free_cells_of_the_box():
    filter = of(3000, start="uniform", box=[[2.0, 0.0], [6.0, 3.0]])
    state, _ = jax.jit(filter.update)(
        filter.init(np.zeros(3), EXACT),
        Scan(np.zeros((2, 2)), np.full(2, -1, np.int32), np.zeros(2, bool)),
        KEY,
    )
    pose = np.asarray(state.pose)
    cells = np.floor((pose[:, :2] - GRID.origin[:2]) / GRID.resolution).astype(int)
    assert np.all(GRID.log_odds[cells[:, 1], cells[:, 0]] < 0) and np.all(pose[:, 0] >= 1.9)
    start = filter.init(np.zeros(3), EXACT)
    mean, cov = filter.estimate(start)[:2]
    spread = np.cov(pose.T)
    np.testing.assert_allclose(mean, pose.mean(axis=0), atol=0.12)
    np.testing.assert_allclose(cov, spread, atol=0.15)


def test_controls_of_a_path_lead_along_it_also_backward():
    rng = np.random.default_rng(1)
    path = np.cumsum(rng.normal(size=(12, 3)), axis=0)
    controls = motion.odometry_controls(path)
    assert not controls[0].any() and (controls[:, 1] < 0).any()
    assert np.abs(controls[:, 0]).max() <= np.pi / 2
    step = jax.jit(jax.vmap(lambda p, u: motion.Odometry(np.eye(3)).step(p, u, np.zeros(3))))
    after = np.asarray(step(path[:-1], controls[1:]))
    np.testing.assert_allclose(after[:, :2], path[1:, :2], atol=1e-12)
    np.testing.assert_allclose(np.exp(1j * after[:, 2]), np.exp(1j * path[1:, 2]), atol=1e-12)


def test_a_log_of_beams_drops_what_says_nothing():
    ranges = np.array([[1.0, np.nan, -1.0], [np.inf, 2.0, 3.0]])
    angles = np.array([[0.0, 0.1, 0.2], [0.0, 0.1, np.nan]])
    log = grids.beam_log(
        np.zeros((2, 3)), Beams(ranges, angles, np.array([[1, 1, 1], [1, 1, 0]], bool))
    )
    np.testing.assert_array_equal(log.scan.valid, [[True, False, False], [True, True, False]])
    assert np.isfinite(log.scan.z).all() and log.scan.z[1, 0, 0] > 1e5


@refused(
    (
        lambda: grids.GridLocalization(GRID._replace(log_odds=abs(GRID.log_odds)), MODEL, MOVE, 9),
        r"GridLocalization: grid: it has no free cell \(log-odds below 0\)",
    ),
    (
        lambda: of(box=[[50, 50], [51, 51]]),
        r"GridLocalization: box: no free cell of the map is in \[\[50\.0, 50\.0\], \[51\.0,",
    ),
    (lambda: of(box=[[1, 1], [0, 0]]), "GridLocalization: box: expected"),
    (lambda: of(exponent=0.0), r"GridLocalization: exponent: expected a number above 0, got 0\.0"),
    (lambda: of(stride=0), "GridLocalization: stride"),
    (lambda: of(0), "GridLocalization: particles"),
    (lambda: of(start="somewhere"), "GridLocalization: start: expected"),
    (lambda: of(forget=(1, 0.1)), "GridLocalization: forget: expected"),
    (
        lambda: grids.GridLocalization(3, MODEL, MOVE, 9),
        "GridLocalization: grid: expected a Grid, got 3",
    ),
    (
        lambda: grids.GridLocalization(GRID, MOVE, MODEL, 9),
        "GridLocalization: model: expected a BeamModel",
    ),
    (
        lambda: grids.beam_log(
            np.zeros((2, 3)), Beams(*np.zeros((2, 2, 4)), np.zeros((2, 4), bool))
        ),
        "beam_log: beams: none of 2 scans has a valid beam",
    ),
    (
        lambda: grids.beam_log(np.zeros((3, 3)), Beams(*np.ones((2, 2, 4)), np.ones((2, 4), bool))),
        r"beam_log: control: expected one \(U,\) for each of 2 scans, got \(3, 3\)",
    ),
    (
        lambda: grids.beam_log(
            np.zeros((2, 3)), Beams(np.ones((2, 4)), np.ones(4), np.ones(4, bool))
        ),
        r"beam_log: beams: expected as many ranges, angles and masks \(T, B\), got \(2,",
    ),
    (lambda: grids.clusters(np.zeros((3, 3)), np.full(3, -np.inf)), "clusters: no particle"),
    (
        lambda: grids.clusters(np.zeros((3, 2)), np.zeros(3)),
        r"clusters: pose: expected poses \(P, 3\) and weights \(P,\), got \(3, 2\), \(3,\)",
    ),
    (
        lambda: motion.odometry_controls(np.zeros(3)),
        "odometry_controls: path: expected finite poses",
    ),
    (lambda: consistency.judge_localization(WORLD, of(), 0, KEY), "judge_localization: runs"),
    (
        lambda: consistency.judge_localization(WORLD, of(), 1, KEY, stride=61),
        "judge_localization: stride: expected at most the 60 steps, got 61",
    ),
    (
        lambda: consistency.judge_localization(WORLD, 3, 1, KEY),
        "judge_localization: filter: expected a Filter, got 3",
    ),
    (
        lambda: consistency.judge_localization(3, of(), 1, KEY),
        "judge_localization: world: expected a LaserWorld, got 3",
    ),
    (lambda: scan_world(ROOM, KEY), "scan_world: world: expected a LaserWorld, got Walls"),
)
def test_bad_input_is_refused(call):
    call()
