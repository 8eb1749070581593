"""Twins of a log: what is drawn about its smoothed path and map, by plain NumPy, and what is refused."""

import dataclasses
from functools import cache

import chex
import drawn_logs
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import refused

from jaxslam import association, catalog, consistency, monte_carlo, motion, run, sensors, smoothing
from jaxslam.core.types import Status
from jaxslam.simulation import Twin, spurious, twin

KEY, DRAWS = jax.random.key(5), 3000


@cache
def of_yard():
    data = drawn_logs.drawn(drawn_logs.yard())
    return data, twin(data)


@cache
def draws(world, count=DRAWS):
    """Truths and logs of many twins, in NumPy."""
    many = jax.jit(jax.vmap(world.draw))
    return jax.device_get(many(jax.random.split(KEY, count)))


def measured(path, landmarks, mount):
    """Range and bearing (…, T, N, 2) of landmarks from a sensor on the robot: plain NumPy."""
    c, s = np.cos(path[..., 2]), np.sin(path[..., 2])
    eye = path[..., :2] + np.stack([c * mount[0] - s * mount[1], s * mount[0] + c * mount[1]], -1)
    gap = landmarks[..., None, :, :] - eye[..., :, None, :]
    bearing = np.arctan2(gap[..., 1], gap[..., 0]) - (path[..., 2] + mount[2])[..., None]
    return np.stack([np.hypot(gap[..., 0], gap[..., 1]), bearing], axis=-1)


def wrapped(angle):
    return np.angle(np.exp(1j * angle))


def has_covariance(values, cov):
    """Check a sample (K, D): mean 0 and a covariance, within four of its standard errors."""
    count = len(values)
    error = np.sqrt(np.diag(cov) / count)
    assert (np.abs(values.mean(axis=0)) < 4.5 * error + 1e-12).all()
    scale = np.sqrt(np.outer(np.diag(cov), np.diag(cov)))
    off = (values.T @ values / count - cov) / np.where(scale > 0, scale, 1.0)
    assert (np.abs(off) < 4.5 * np.sqrt(2 / count)).all(), off


def test_path_and_map_are_those_of_the_batch_solution():
    data, world = of_yard()
    estimator = smoothing.BatchMap(
        data.motion, data.sensor, data.capacity, data.pose, data.pose_cov, iterations=100
    )
    trace = estimator(data.log, jax.random.key(0))
    found = jax.jit(lambda: world.drive(jnp.asarray(world.pose), jnp.zeros((60, 2))))()[0]
    np.testing.assert_allclose(found, trace.estimate.pose, atol=1e-9)
    order = np.argsort(trace.estimate.tag[-1])
    np.testing.assert_allclose(world.landmarks, trace.estimate.points[-1][order], atol=1e-9)


def test_each_row_sees_what_the_log_saw_in_its_order():
    data, world = of_yard()
    truth, log = draws(world)
    scan = data.log.scan
    np.testing.assert_array_equal(log.scan.valid[7], scan.valid)
    np.testing.assert_array_equal(log.scan.tag[7], np.where(scan.valid, scan.tag, -1))
    assert world.tags == data.tags and world.left_out == 0
    path = jax.jit(lambda: world.drive(jnp.asarray(world.pose), jnp.zeros((60, 2))))()[0]
    np.testing.assert_allclose(truth.pose, np.broadcast_to(path, truth.pose.shape), atol=1e-9)
    assert not truth.missed.any() and truth.origin is None


def test_noises_of_scans_and_odometry_are_those_of_the_models():
    _, world = of_yard()
    truth, log = draws(world)
    exact = measured(truth.pose, truth.landmarks, np.asarray(world.sensor.mount))
    row, place = np.nonzero(np.asarray(world.seen) >= 0)
    noise = log.scan.z[:, row, place] - exact[:, row, np.asarray(world.seen)[row, place]]
    noise[..., 1] = wrapped(noise[..., 1])
    has_covariance(noise[:, 11], np.diag([0.05, 0.02]) ** 2)
    has_covariance(noise.reshape(-1, 2)[::7], np.diag([0.05, 0.02]) ** 2)
    assert abs(np.mean(noise[:, 3] * noise[:, 4])) < 5 * 0.05 * 0.02 / np.sqrt(DRAWS)
    # The controls of which the path is made, from the path by NumPy.
    before = np.concatenate([np.zeros((1, 3)), truth.pose[0, :-1]])
    step = truth.pose[0] - before
    v = np.hypot(step[:, 0], step[:, 1]) / drawn_logs.DT
    omega = wrapped(step[:, 2]) / drawn_logs.DT
    noise = log.control[:, :, :2] - np.stack([v, omega], axis=1)
    has_covariance(noise[:, 20], np.diag([0.1, 0.05]) ** 2)
    has_covariance(noise.reshape(-1, 2)[::7], np.diag([0.1, 0.05]) ** 2)
    assert (log.control[..., 2] == drawn_logs.DT).all()


def test_a_noise_that_no_control_undoes_moves_the_path_a_little():
    """`Velocity` turns at the end of a step as no control does; Δt stays, and the models hold."""
    world = drawn_logs.yard(model=motion.Velocity, noise=(0.1, 0.05, 0.02))
    like = twin(drawn_logs.drawn(world))
    truth, log = draws(like, 500)
    smoothed = np.asarray(jax.jit(lambda: like.drive(jnp.zeros(3), jnp.zeros((60, 3))))()[0])
    assert 0 < np.abs(truth.pose[:, -1, :2] - smoothed[-1, :2]).max() < 0.05
    # Undone by none, the noise of the turns alone would be 0.02 · 0.2 · √60 = 0.03.
    np.testing.assert_allclose(wrapped(truth.pose[..., 2] - smoothed[:, 2]), 0, atol=2e-3)
    assert (log.control[..., 2] == drawn_logs.DT).all()
    u_hat = np.asarray(like.controls)[:, :2] + np.asarray(like.noise)[:, :2]
    noise = (log.control[..., :2] - u_hat).reshape(-1, 2)
    # The turn is w_ω + w_γ less the smoothed w_γ, which is the same in all.
    gamma = np.asarray(like.noise)[:, 2]
    noise[:, 1] -= np.tile(gamma, 500)
    has_covariance(noise, np.diag([0.1**2, 0.05**2 + 0.02**2]))


def test_a_vague_start_moves_path_and_map_together():
    cov = np.diag([0.3, 0.2, 0.1]) ** 2
    world = drawn_logs.yard(pose=(1.0, -2.0, 0.4), pose_cov=cov)
    like = twin(drawn_logs.drawn(world))
    truth, _ = draws(like, 2000)
    error = truth.start - np.asarray(like.pose)
    error[:, 2] = wrapped(error[:, 2])
    has_covariance(error, cov)
    ranges = measured(truth.pose, truth.landmarks, np.zeros(3))[..., 0]
    np.testing.assert_allclose(ranges, ranges[:1] + 0 * ranges, atol=1e-9)
    assert np.ptp(truth.landmarks[:, 0, 0]) > 0.5


def test_nothing_comes_from_the_truth():
    data, world = of_yard()
    wrong = dataclasses.replace(
        data,
        landmarks=np.full((6, 2), 7.0),
        true_path=np.full((60, 3), np.nan),
        true_at=np.zeros(60, bool),
    )
    chex.assert_trees_all_equal(twin(wrong), world)


def test_without_tags_the_associated_landmarks_are_drawn():
    """The filters associate again; a measurement that nothing explains has no twin."""
    world = drawn_logs.yard()
    data = drawn_logs.drawn(world)
    rule = {"associate": association.Nearest(0.99, 0.9999)}
    valid = np.asarray(data.log.scan.valid)
    z = np.array(data.log.scan.z)
    row, place = np.argwhere(valid[30:])[0] + [30, 0]
    z[row, place, 0] += 0.5  # between the gates of its landmark and of a new one, or new
    data = drawn_logs.with_scan(data, z=z, tag=np.full(valid.shape, -1, np.int32))
    data = dataclasses.replace(data, filter_options=data.filter_options | rule, slots=12, tags=())
    like = twin(data)
    ekf = catalog.FILTERS["ekf"](like)
    info = run(ekf, data.log, data.pose, data.pose_cov, KEY).info
    used = np.isin(info.status, [Status.FUSED, Status.BORN])
    np.testing.assert_array_equal(np.asarray(like.seen) >= 0, used)
    assert like.left_out == valid.sum() - used.sum()
    assert like.associates and like.capacity == 12 == ekf.capacity
    truth, log = draws(like, 20)
    np.testing.assert_array_equal(truth.origin, log.scan.tag)
    points = np.asarray(like.landmarks)
    nearest = np.hypot(*(points[:, None] - drawn_logs.POSTS[None]).transpose(2, 0, 1)).min(axis=1)
    assert np.sort(nearest)[:6].max() < 0.3


@pytest.mark.sweep
def test_ranges_alone_are_smoothed_from_the_odometry():
    """Where the posts are is not known beforehand; the optimum has the likelihood of the truth."""
    world = drawn_logs.yard(steps=150)
    sensor = sensors.RangeOnly(np.array([[0.05**2]]), mount=(0.2, 0.0, 0.1))
    data = drawn_logs.drawn(dataclasses.replace(world, sensor=sensor, filter_options={}))
    like = twin(data)
    far = np.hypot(*(np.asarray(like.landmarks) - drawn_logs.POSTS).T)
    assert far.max() < 0.5
    _, log = draws(like, 10)
    np.testing.assert_array_equal(log.scan.valid[3], data.log.scan.valid)


def test_outliers_are_put_in_where_they_are_wanted():
    data, _ = of_yard()
    like = twin(data, spurious=spurious.Spurious(outliers=0.2, reach=5.0))
    truth, log = draws(like, 200)
    share = ((truth.origin < 0) & log.scan.valid).sum() / log.scan.valid.sum()
    assert abs(share - 0.2) < 4 * np.sqrt(0.16 / log.scan.valid.sum())


def test_a_twin_is_a_world_as_any_other():
    _, world = of_yard()
    assert isinstance(world, Twin) and world.name == "twin of yard"
    filters = {"dead_reckoning": catalog.ALL["dead_reckoning"](world)}
    summary = monte_carlo(world, filters, 16, KEY, progress=False).filters["dead_reckoning"]
    assert summary.counts["runs"] == 16 and summary.verdict in ("consistent", "undecided")

    def spread(world):
        truth, log = world.draw(KEY)
        bound = consistency.conditional_bound(world, truth, log, KEY).pose_cov[-1]
        return jnp.trace(jnp.asarray(bound)) + (jnp.asarray(log.control) ** 2).sum()

    def of_scale(scale):
        noise = dataclasses.replace(world.motion, noise_cov=np.diag([0.1, 0.05]) ** 2 * scale)
        return spread(dataclasses.replace(world, motion=noise))

    slope = jax.jit(jax.grad(of_scale))
    value = jax.jit(of_scale)
    found, step = float(slope(1.0)), 1e-4
    expected = (float(value(1 + step)) - float(value(1 - step))) / (2 * step)
    assert found == pytest.approx(expected, rel=1e-4)


@cache
def of_gyroscope():
    """The yard by odometry with a bias, which the start does not know, and its twin."""
    biased = motion.BiasedOdometry(motion.NoiseDensity(np.array([0.01, 0.01, 0.01, 0.01])))
    world = dataclasses.replace(
        drawn_logs.yard(),
        motion=biased,
        pose=np.array([0.0, 0.0, 0.0, 0.1, 1.0]),
        pose_cov=np.diag([0.0, 0.0, 0.0, 0.1, 0.05]) ** 2,
    )
    data = drawn_logs.drawn(world)
    return data, twin(data)


def test_a_bias_is_drawn_anew_and_the_path_stays():
    """By NumPy: the smoothed path; biases from the prior on, which walk as the model says; and
    controls that have these biases."""
    data, world = of_gyroscope()
    truth, log = draws(world, 800)
    estimator = smoothing.BatchMap(
        data.motion, data.sensor, data.capacity, data.pose, data.pose_cov, iterations=100
    )
    path = np.asarray(estimator(data.log, jax.random.key(0)).estimate.pose)
    np.testing.assert_allclose(truth.pose, np.broadcast_to(path, truth.pose.shape), atol=1e-8)
    assert truth.further.shape == (800, 60, 2)
    has_covariance(truth.start[:, 3:] - [0.1, 1.0], np.diag([0.1, 0.05]) ** 2)
    before = np.concatenate([truth.start[:, None, 3:], truth.further[:, :-1]], axis=1)
    steps = (truth.further - before).reshape(-1, 2)
    has_covariance(steps[::7], np.diag([0.01, 0.01]) ** 2 * drawn_logs.DT)
    # Travel and turn of the path, from the controls less what the odometry adds to them.
    from_start = np.concatenate([np.zeros((1, 3)), path[:-1]])
    turn = wrapped(path[:, 2] - from_start[:, 2])
    chord = np.hypot(*(path - from_start)[:, :2].T)
    travel = chord / np.sinc(turn / 2 / np.pi)
    noise = np.stack(
        [
            log.control[..., 0] - travel / drawn_logs.DT / before[..., 1],
            log.control[..., 1] - turn / drawn_logs.DT - before[..., 0],
        ],
        axis=-1,
    )
    has_covariance(noise[:, 20], np.diag([0.01, 0.01]) ** 2 / drawn_logs.DT)
    has_covariance(noise.reshape(-1, 2)[::7], np.diag([0.01, 0.01]) ** 2 / drawn_logs.DT)


def test_a_filter_with_the_bias_is_honest_on_its_twins_and_the_check_passes():
    data, world = of_gyroscope()
    filters = {"ekf": catalog.FILTERS["ekf"](world)}
    summary = monte_carlo(world, filters, 48, KEY, progress=False).filters["ekf"]
    assert summary.verdict in ("consistent", "undecided")
    for name in ("nees_of_bias", "nees_of_scale", "nees_further"):
        value, low, high = summary.measures[name]
        assert low < 1 < high, name
    checked = consistency.check_models(world, filters["ekf"], data.log, twins=20, key=KEY)
    assert checked.findings == (), str(checked)


def once_seen():
    data, _ = of_yard()
    valid = np.zeros_like(data.log.scan.valid)
    row, place = np.argwhere(np.asarray(data.log.scan.valid))[3]
    valid[row, place] = True
    return drawn_logs.with_scan(data, valid=valid)


def changed(**fields):
    return lambda: dataclasses.replace(of_yard()[0], **fields)


def not_converging():
    data, _ = of_yard()
    z = np.where(np.asarray(data.log.scan.valid)[..., None], [1e30, 0.0], 0.0)
    return drawn_logs.with_scan(data, z=z)


def coasting():
    """A log of a robot without odometry."""
    data, _ = of_yard()
    log = data.log._replace(control=np.full((60, 1), drawn_logs.DT))
    model = motion.ConstantVelocity(np.eye(2))
    beside = {"pose": np.zeros(5), "pose_cov": np.zeros((5, 5))}
    return dataclasses.replace(data, motion=model, log=log, **beside)


@refused(
    (once_seen, "dataset: expected a landmark that is seen twice"),
    (changed(default_noises=("motion",)), r"no noise of \[motion\], .* jaxslam fit FOLDER --write"),
    (changed(motion=motion.Unicycle(np.zeros((2, 2)))), "the motion of yard has no noise"),
    (changed(robots=(object(),)), "expected the log of one robot"),
    (
        coasting,
        r"motion: expected odometry that moves the pose and nothing else.* with v \[m/s\], omega",
    ),
    (not_converging, "the smoothing of yard did not converge"),
    told="twin: .*",
)
def test_refused(make):
    twin(make())
