"""Monte-Carlo localization: the EKF's posterior, a robot anywhere, one carried away, bad particles."""

import dataclasses
import math
from functools import cache

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds
from cases import refused, swept
from own_models import changed
from reference.plane import from_frame

from jaxslam import association, motion, resampling, run, sensors
from jaxslam.core.types import Scan, Status
from jaxslam.filters import FastSlam, Localization, ParticleLocalization
from jaxslam.filters._particles import pose_particles
from jaxslam.math.stats import sigma_gate
from jaxslam.sensors import Part, Suite

KEY = jax.random.key(5)
WORLD = worlds.ring(100)
MOUNT = (0.1, -0.05, 0.3)
BLUNT = sensors.RangeBearing(np.diag([0.3, 0.1]) ** 2, mount=MOUNT)
MOVE = jax.jit(WORLD.motion.step)
BOX = np.array([[-4.0, -3.0], [4.0, 5.0]])


def of(count, sensor=WORLD.sensor, move=WORLD.motion, **options):
    return ParticleLocalization(move, sensor, WORLD.landmarks, count, **options)


def drive(filter, log, pose=(0.0, 0.0, 0.0), cov=None):
    cov = np.zeros((3, 3)) if cov is None else cov
    return jax.device_get(run(filter, log, pose, cov, KEY))


def history(steps, pose=(0.0, 0.0, 0.0), seed=1, sensor=WORLD.sensor):
    """Truth and log of so many steps of the ring from a pose; one program draws them all."""
    world = dataclasses.replace(
        WORLD, controls=np.asarray(WORLD.controls)[:40], pose=pose, sensor=sensor
    )
    truth, log = worlds.draw(world, seed)
    path = truth._replace(pose=truth.pose[:steps])
    return path, jax.tree.map(lambda leaf: leaf[:steps], log)


# --- the right posterior ------------------------------------------------------------------------


def test_many_particles_are_the_posterior_of_the_ekf():
    """Mean within 5 standard errors, covariance within 15 %, and the evidence of the log."""
    _, log = history(6)
    start = (0.02, -0.03, 0.01), np.diag([0.05, 0.05, 0.02]) ** 2
    theirs = run(Localization(WORLD.motion, WORLD.sensor, WORLD.landmarks), log, *start, KEY)
    ours = drive(of(2000, least=2000), log, *start)
    mean, cov = np.asarray(theirs.estimate.pose[-1]), np.asarray(theirs.estimate.pose_cov[-1])
    error = np.asarray(ours.estimate.pose[-1]) - mean
    effective = float(ours.info.extra["particles"].ess[-1])
    assert effective > 100
    assert np.all(np.abs(error) < 5 * np.sqrt(cov.diagonal() / (effective / 4)))
    np.testing.assert_allclose(
        np.asarray(ours.estimate.pose_cov[-1]).diagonal(), cov.diagonal(), rtol=0.25
    )
    np.testing.assert_allclose(
        ours.info.log_likelihood.sum(), theirs.info.log_likelihood.sum(), atol=0.5
    )
    assert (np.asarray(ours.info.extra["particles"].active) == 2000).all()
    np.testing.assert_array_equal(ours.info.status, theirs.info.status)
    np.testing.assert_array_equal(ours.estimate.points, theirs.estimate.points)


def by_hand(pose, scan, gate=math.inf, edge=9.21034037197618):
    """Σ of what counts of d² for one pose: range and bearing to the landmarks of their tags."""
    eye = from_frame(pose, MOUNT[:2])
    total = 0.0
    for (r, b), tag, there in zip(*map(np.asarray, scan), strict=True):
        if not there:
            continue
        if tag < 0:
            total += min(edge, gate)
            continue
        dx, dy = np.asarray(WORLD.landmarks)[tag] - eye
        turn = b - (np.arctan2(dy, dx) - pose[2] - MOUNT[2])
        turn = (turn + np.pi) % (2 * np.pi) - np.pi
        total += min(((r - np.hypot(dx, dy)) / 0.3) ** 2 + (turn / 0.1) ** 2, gate)
    return total


@cache
def one_scan():
    """The first scan of the ring."""
    return jax.tree.map(lambda leaf: leaf[0], history(1)[1].scan)


def updated(filter, scan, spread):
    """One update from the origin with standard deviations, drawn at the first."""

    @jax.jit
    def both(scan):
        start = filter.init(jnp.zeros(3), jnp.diag(np.square(spread)))
        return filter.update(start, scan, KEY)

    return jax.device_get(both(scan))


def assert_weighs(after, info, off):
    """The weights are exp(-off / 2), normalized."""
    w = np.exp(-0.5 * (off - off.min()))
    np.testing.assert_allclose(np.exp(after.log_weight), w / w.sum(), rtol=1e-9)
    assert int(after.best) == np.argmax(w)
    np.testing.assert_allclose(info.extra["particles"].ess, w.sum() ** 2 / (w**2).sum(), rtol=1e-9)


@pytest.mark.parametrize("gate", swept([math.inf, 16.0], 16.0))
def test_weights_are_the_scans_densities(gate):
    scan = jax.tree.map(np.array, one_scan())
    scan.tag[2], scan.valid[5] = -1, False
    scan.z[4] += [3.0, 0.0]
    filter = of(30, BLUNT, gate=None if gate == math.inf else sigma_gate(4, 2))
    after, info = updated(filter, scan, [0.3, 0.3, 0.2])
    assert len(np.unique(after.pose[:, 0])) == 30  # drawn, each for itself
    edge = {} if gate == math.inf else {"edge": gate}
    off = np.array([by_hand(p, scan, gate, **edge) for p in after.pose])
    assert_weighs(after, info, off)
    wanted = [Status.FUSED] * 6
    wanted[2], wanted[5] = Status.UNMATCHED, Status.EMPTY
    if gate == 16.0 and info.nis[4] > 16:
        wanted[4] = Status.REJECTED
    np.testing.assert_array_equal(info.status, wanted)
    # the average of how well they fit, by 5 places
    np.testing.assert_allclose(after.fast, np.exp(-off / 10).mean(), rtol=1e-9)
    np.testing.assert_allclose(after.slow, after.fast)


@pytest.mark.sweep
def test_landmarks_far_apart_are_known_without_tags_by_each_particle():
    truth, log = history(8)
    likeliest = association.MaximumLikelihood(None)
    trace = drive(
        of(60, BLUNT, associate=likeliest), worlds.nameless(log), cov=np.diag([0.1, 0.1, 0.05]) ** 2
    )
    np.testing.assert_array_equal(trace.info.slot, log.scan.tag)
    assert np.linalg.norm(trace.estimate.pose[-1, :2] - truth.pose[-1, :2]) < 0.3


@pytest.mark.sweep
def test_absolute_sensors_of_a_suite_weigh_too():
    eyes = Suite(((BLUNT, 6), Part(sensors.Compass(np.array([[0.04]])), 1)))
    scan, filter = one_scan(), of(20, eyes)
    whole = Scan(
        np.concatenate([scan.z, [[0.3, 0.0]]]),
        np.append(scan.tag, np.int32(-1)),
        np.append(scan.valid, True),
    )
    after, info = updated(filter, whole, [0.3, 0.3, 0.4])
    off = [by_hand(p, scan) + (0.3 - p[2]) ** 2 / 0.04 for p in after.pose]
    assert_weighs(after, info, np.array(off))
    np.testing.assert_array_equal(info.dof, [2] * 6 + [1])
    np.testing.assert_array_equal(info.status, [Status.FUSED] * 7)
    assert filter.places == (6, 1)


# --- from anywhere, and carried away --------------------------------------------------------------


@pytest.fixture(scope="module")
def carried():
    """A robot anywhere, put down elsewhere after 40 steps: error [m] (runs, T), both filters."""
    first, second = (
        history(40, pose, seed) for pose, seed in (((0.5, 1.0, 2.0), 1), ((1.5, 2.5, -2.0), 2))
    )
    log = jax.tree.map(lambda a, b: np.concatenate([a, b]), first[1], second[1])
    truth = np.concatenate([first[0].pose, second[0].pose])
    lost = of(1000, BLUNT, box=BOX, start="uniform")
    keys = jax.random.split(KEY, 6)
    go = jax.jit(jax.vmap(lambda key: run(lost, log, np.zeros(3), np.zeros((3, 3)), key)))
    ours = go(keys)
    ekf = Localization(WORLD.motion, BLUNT, WORLD.landmarks, gate=sigma_gate(4, 2))
    theirs = drive(ekf, log, (0.5, 1.0, 2.0))  # which is told where it starts
    off = np.linalg.norm(np.asarray(ours.estimate.pose)[:, :, :2] - truth[:, :2], axis=2)
    ekf_off = np.linalg.norm(np.asarray(theirs.estimate.pose)[:, :2] - truth[:, :2], axis=1)
    return ours, off, ekf_off


def test_a_robot_that_may_be_anywhere_is_found(carried):
    _, off, _ = carried
    assert (off[:, 30:40].max(axis=1) < 0.6).all()


def test_a_kidnapped_robot_is_found_again_and_by_the_ekf_it_is_not(carried):
    ours, off, ekf_off = carried
    assert (off[:, 41] > 1.0).all()
    assert (off[:, 72:].max(axis=1) < 0.6).sum() >= 5
    assert ekf_off[39] < 0.3
    assert ekf_off[40:].min() > 1.0
    injected = np.asarray(ours.info.extra["particles"].injected)
    assert (injected[:, 41:60].sum(axis=1) > 0).all()
    assert injected[:, 42:60].sum() > 5 * injected[:, 22:40].sum()


def test_the_number_of_particles_follows_the_uncertainty(carried):
    ours, _, _ = carried
    active = np.asarray(ours.info.extra["particles"].active)
    assert (active[:, 0] == 1000).all()
    assert (np.median(active[:, 10:40], axis=1) < 200).all()
    assert (active >= 50).all() and (active <= 1000).all()
    # all that is in use weighs, and nothing else
    weight = np.asarray(ours.final.log_weight)
    for row, count in zip(weight, np.asarray(ours.final.active), strict=True):
        assert np.isneginf(row[count:]).all()
        np.testing.assert_allclose(np.exp(row[:count]).sum(), 1.0, rtol=1e-9)
    poses = np.asarray(ours.final.pose)
    assert np.isfinite(poses).all()


@pytest.mark.sweep
def test_what_is_not_in_use_is_inert():
    _, log = history(2)
    filter = of(40, BLUNT, threshold=0.0)
    in_use, wild = np.arange(40) < 25, np.array([7.0, -9.0, 1.0])

    @jax.jit
    def go(unused):
        state = filter.init(jnp.zeros(3), np.diag([0.1, 0.1, 0.05]) ** 2)
        start = filter.predict(state, log.control[0], KEY)
        start = start._replace(
            active=jnp.int32(25),
            log_weight=jnp.where(in_use, -math.log(25), -jnp.inf),
            pose=jnp.where(in_use[:, None] | ~unused, start.pose, wild),
        )
        state = filter.predict(start, log.control[1], KEY)
        state, info = filter.update(state, jax.tree.map(lambda x: x[1], log.scan), KEY)
        return info, filter.estimate(state), state.log_weight

    chex.assert_trees_all_equal(go(np.array(False)), go(np.array(True)))


# --- particles that are no use ------------------------------------------------------------------


def breaking(level):
    """A motion that loses the pose of those whose noise is above level."""

    def step(pose, u, w):
        moved = WORLD.motion.step(pose, u, w)
        return jnp.where(w[0] > level, jnp.nan, moved)

    return changed(WORLD.motion, step=step)


@pytest.mark.sweep
@pytest.mark.parametrize("kind", ["localization", "fastslam"])
def test_poses_that_are_not_finite_weigh_nothing_and_are_counted(kind):
    _, log = history(3)

    @jax.jit
    def go(level):
        if kind == "localization":
            filter = of(16, BLUNT, breaking(level))
        else:
            filter = FastSlam(breaking(level), BLUNT, 6, 16, proposal="motion")
        probe = lambda s: (s.pose, s.log_weight)  # noqa: E731
        return run(filter, log, np.zeros(3), np.zeros((3, 3)), KEY, probe=probe)

    some, every = go(0.0), go(-9.0)
    chex.assert_tree_all_finite([(t.estimate, t.info, t.probe[0]) for t in (some, every)])
    invalid = np.asarray(some.info.extra["particles"].invalid)
    assert ((invalid > 0) & (invalid < 16)).all()
    assert not np.any(some.info.extra["particles"].underflow)
    if kind == "localization":  # whose weights are those before resampling
        np.testing.assert_array_equal((np.exp(some.probe[1]) == 0).sum(axis=1), invalid)
    np.testing.assert_array_equal(every.info.extra["particles"].invalid, 16)
    assert np.all(every.info.extra["particles"].underflow)
    np.testing.assert_allclose(np.exp(every.probe[1]), 1 / 16)
    np.testing.assert_array_equal(every.estimate.pose, 0.0)  # as before


def test_where_all_weights_underflow_the_filter_goes_on_and_counts():
    scan = Scan(np.array([[1e200, 0.0]]), np.array([0], np.int32), np.array([True]))
    filter = of(4, BLUNT)
    after, info = updated(filter, scan, [0.1, 0.1, 0.1])
    assert info.extra["particles"].underflow
    np.testing.assert_allclose(np.exp(after.log_weight), 0.25)
    np.testing.assert_array_equal(info.status, [Status.REJECTED])
    assert info.log_likelihood == 0.0
    chex.assert_tree_all_finite((info, jax.jit(filter.estimate)(after)))


@pytest.mark.sweep
@pytest.mark.parametrize("count", [1, 7])
def test_without_any_noise_or_with_one_particle_it_is_dead_reckoning(count):
    """A proposal without spread, from a start without any: all particles are one."""
    _, log = history(5)
    trace = drive(of(count, BLUNT, motion.Increment(np.zeros((2, 2)))), log)
    pose = np.zeros(3)
    for u, ours in zip(np.asarray(log.control), np.asarray(trace.estimate.pose), strict=True):
        pose = np.asarray(MOVE(pose, u, np.zeros(2)))
        np.testing.assert_allclose(ours, pose, atol=1e-12)
    np.testing.assert_allclose(trace.estimate.pose_cov, 0.0, atol=1e-24)
    assert not np.any(trace.info.extra["particles"].underflow)
    np.testing.assert_array_equal(trace.info.extra["particles"].active, count)


# --- the house ----------------------------------------------------------------------------------


def test_the_start_is_reported_before_anything_is_drawn():
    cov = np.diag([0.1, 0.2, 0.3])
    known, anywhere = of(5), of(5, box=BOX, start="uniform")
    out = jax.jit(lambda *at: known.estimate(known.init(*at)))(np.array([1.0, 2, 3]), cov)
    np.testing.assert_allclose(out.pose, [1, 2, 3], atol=1e-12)
    np.testing.assert_allclose(out.pose_cov, cov, atol=1e-12)
    out = jax.jit(lambda *at: anywhere.estimate(anywhere.init(*at)))(np.ones(3), np.zeros((3, 3)))
    np.testing.assert_allclose(out.pose, [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(out.pose_cov, np.diag([64, 64, 4 * np.pi**2]) / 12, rtol=1e-12)
    uniform = jax.jit(lambda key: pose_particles.Box(BOX).draw(20000, key, float))
    draws = np.asarray(uniform(KEY))
    assert (draws[:, :2] > BOX[0]).all() and (draws[:, :2] < BOX[1]).all()
    np.testing.assert_allclose(np.cov(draws.T), out.pose_cov, atol=0.15)


@pytest.mark.sweep
def test_runs_of_a_batch_know_nothing_of_each_other_and_float32_stays_float32():
    _, log = history(4)
    filter = of(30, BLUNT, box=BOX)
    go = jax.jit(lambda log, key: run(filter, log, np.zeros(3), np.eye(3) * 0.01, key))
    keys = jax.random.split(KEY, 2)
    batch = jax.jit(jax.vmap(go, (None, 0)))
    both, swapped = batch(log, keys), batch(log, keys[::-1])
    chex.assert_trees_all_equal(both, jax.tree.map(lambda leaf: leaf[::-1], swapped))
    assert np.all(both.final.pose[0] != both.final.pose[1])
    single = worlds.narrow(log)
    for leaf in jax.tree.leaves(jax.eval_shape(go, single, KEY)):
        assert leaf.dtype != np.float64


@pytest.mark.sweep
def test_gradients_are_finite_from_a_start_that_is_known_exactly():
    _, log = history(3)

    def cost(sigma):
        move = motion.Increment(jnp.diag(sigma[:2]) ** 2)
        sensor = sensors.RangeBearing(sigma[2] ** 2 * jnp.eye(2), mount=MOUNT)
        filter = of(12, sensor, move, resample=resampling.StopGradient(), box=BOX)
        trace = run(filter, log, np.zeros(3), np.zeros((3, 3)), KEY)
        return trace.info.log_likelihood.sum() + trace.estimate.pose_cov[-1].sum()

    slope = jax.jit(jax.grad(cost))(np.array([0.01, 0.04, 0.3]))
    assert np.isfinite(slope).all()
    assert np.all(slope != 0)


@refused(
    ({"particles": 0}, "particles: expected an integer"),
    ({"particles": 2.5}, "particles: expected an integer"),
    ({"least": 0}, "least: expected an integer"),
    ({"least": 6}, "least: expected at most particles = 5"),
    (
        {"landmarks": np.zeros((3, 3))},
        r"ParticleLocalization: landmarks: expected shape \(at least 1, 2\), got \(3, 3\)",
    ),
    (
        {"tags": [0, 0, 1, 2, 3, 4]},
        "ParticleLocalization: tags: expected 6 different ones from 0 to",
    ),
    ({"start": "anywhere"}, 'start: expected "gaussian" or "uniform"'),
    ({"start": "uniform"}, "box: expected"),
    ({"box": [[0, 0, 0], [1, 1, 1]]}, "box: expected shape"),
    ({"box": [[1, 1], [0, 2]]}, "box: expected shape"),
    ({"threshold": 1.5}, "threshold: expected a number from 0 to 1"),
    ({"gate": 0.0}, "gate: expected a probability above 0 and below 1"),
    ({"forget": (0.2, 0.1)}, "0 < slow <= fast <= 1"),
    ({"resample": "systematic"}, "resample: expected a function"),
)
def test_bad_input_is_refused(change):
    given = {"landmarks": WORLD.landmarks, "particles": 5} | change
    ParticleLocalization(WORLD.motion, WORLD.sensor, **given)
