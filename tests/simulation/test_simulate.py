"""simulate: the noise has the covariance it should, scans hold what is in view, scenarios are as published.

Statistical checks use bands of five standard errors, so a fixed key fails by chance about once in a
million checks; `assert_standard_normal` says what it holds.
"""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from cases import refused
from own_models import changed
from reference.plane import mounted, to_frame, wrap

from jaxslam import Scenario, filters, motion, run, sensors, simulate
from jaxslam.math.stats import sigma_gate
from jaxslam.simulation.scenarios import (
    SCENARIOS,
    BetweenRanges,
    circle,
    cloister,
)
from jaxslam.simulation.scenarios._published import cloister_landmarks

Q = np.array([[0.002, 0.0005], [0.0005, 0.001]])
R = np.array([[0.04, -0.01], [-0.01, 0.01]]) * 0.25
LANDMARKS = np.array([[2.0, 1.0], [-3.0, 2.0], [0.5, -2.5], [4.0, -1.0], [-1.0, 5.0]])
MOUNT = np.array([0.3, -0.2, 0.5])


def world(steps=300, **changes):
    options = {
        "name": "test",
        "motion": motion.Increment(Q),
        "sensor": sensors.RangeBearing(R, mount=MOUNT),
        "landmarks": LANDMARKS,
        "controls": np.tile([[0.1, 0.05], [-0.05, 0.1]], (steps // 2, 1)),
        "pose": (1.0, -1.0, 3.0),
    }
    return Scenario(**(options | changes))


def draw(scenario, seed=0, runs=None):
    key = jax.random.key(seed)
    if runs is None:
        return jax.device_get(simulate(scenario, key))
    many = jax.jit(jax.vmap(functools.partial(simulate, scenario)))
    return jax.device_get(many(jax.random.split(key, runs)))


def nominal_path(scenario):
    pose, path = np.array(scenario.pose, float), []
    for d, turn in np.asarray(scenario.controls):
        step = [d * np.cos(pose[2]), d * np.sin(pose[2]), turn]
        pose = pose + step
        path.append([pose[0], pose[1], wrap(pose[2])])
    return np.array(path)


def executed_controls(scenario, pose):
    """The (forward, turn) of each step of true paths (…, T, 3)."""
    start = np.broadcast_to(np.array(scenario.pose, float), (*pose.shape[:-2], 1, 3))
    before = np.concatenate([start, pose[..., :-1, :]], axis=-2)
    dx = pose - before
    ahead = dx[..., 0] * np.cos(before[..., 2]) + dx[..., 1] * np.sin(before[..., 2])
    aside = -dx[..., 0] * np.sin(before[..., 2]) + dx[..., 1] * np.cos(before[..., 2])
    np.testing.assert_allclose(aside, 0, atol=1e-12)
    return np.stack([ahead, wrap(dx[..., 2])], axis=-1)


def exact_measurements(pose, landmarks=LANDMARKS, mount=MOUNT):
    """(…, T, N, 2) range and bearing from the mounted sensor."""
    frame = mounted(pose, mount)[..., None, :]
    dx, dy = landmarks[:, 0] - frame[..., 0], landmarks[:, 1] - frame[..., 1]
    bearing = wrap(np.arctan2(dy, dx) - frame[..., 2])
    return np.stack([np.hypot(dx, dy), bearing], axis=-1)


def measurement_noise(truth, log):
    """z less what is exact, of worlds in which everything is in view."""
    noise = log.scan.z - exact_measurements(truth.pose)
    noise[..., 1] = wrap(noise[..., 1])
    return noise


def whiten(noise, cov):
    return np.linalg.solve(np.linalg.cholesky(cov), noise[..., None])[..., 0]


def assert_standard_normal(samples):
    """Means within 5/√n, second moments within 5·√((1+δ_ij)/n), Kolmogorov-Smirnov p > 1e-5."""
    samples = samples.reshape(-1, samples.shape[-1])
    n, d = samples.shape
    assert n > 2000
    assert np.abs(samples.mean(axis=0)).max() < 5 / np.sqrt(n)
    moments, eye = samples.T @ samples / n, np.eye(d)
    assert np.all(np.abs(moments - eye) < 5 * np.sqrt((1 + eye) / n))
    for column in samples.T:
        assert scipy.stats.kstest(column, "norm").pvalue > 1e-5


def assert_uncorrelated(a, b):
    """Every entry of a with every entry of b, sample by sample, within 5/√n."""
    a, b = a.reshape(-1, a.shape[-1]), b.reshape(-1, b.shape[-1])
    assert np.abs(a.T @ b / len(a)).max() < 5 / np.sqrt(len(a))


# --- noise --------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=["robot", "odometry"])
def drawn(request):
    scenario = world(noise_on=request.param)
    return scenario, *draw(scenario, runs=10)


def motion_noise(scenario, truth, log):
    if scenario.noise_on == "robot":
        return executed_controls(scenario, truth.pose) - log.control
    return log.control - np.asarray(scenario.controls)


def test_motion_noise_has_its_covariance(drawn):
    noise = motion_noise(*drawn)
    assert_standard_normal(whiten(noise, Q))


def test_measurement_noise_has_its_covariance(drawn):
    _, truth, log = drawn
    assert log.scan.valid.all()
    assert np.abs(log.scan.z[..., 1]).max() <= np.pi
    assert_standard_normal(whiten(measurement_noise(truth, log), R))


def test_noise_is_independent_over_time_places_runs_and_sources(drawn):
    scenario, truth, log = drawn
    w = whiten(motion_noise(*drawn), Q)
    v = whiten(measurement_noise(truth, log), R)
    assert_uncorrelated(w[:, 1:], w[:, :-1])
    assert_uncorrelated(v[:, 1:, 0], v[:, :-1, 0])
    assert_uncorrelated(v[:, :, 0], v[:, :, 1])
    assert_uncorrelated(w, v[:, :, 0])
    assert_uncorrelated(w[1:], w[:-1])
    assert_uncorrelated(v[1:], v[:-1])


def test_where_the_noise_acts(drawn):
    scenario, truth, log = drawn
    path = nominal_path(scenario)
    if scenario.noise_on == "robot":  # the log knows the nominal control alone
        np.testing.assert_array_equal(
            log.control, np.broadcast_to(scenario.controls, log.control.shape)
        )
        assert np.abs(truth.pose[0] - path).max() > 0.1
        assert np.abs(truth.pose[0] - truth.pose[1]).max() > 0.1
    else:  # the robot follows the nominal path
        np.testing.assert_allclose(truth.pose[..., :2] - path[:, :2], 0, atol=1e-12)
        np.testing.assert_allclose(wrap(truth.pose[..., 2] - path[:, 2]), 0, atol=1e-12)
    assert np.abs(truth.pose[..., 2]).max() <= np.pi


def test_noise_may_depend_on_control_and_measurement():
    """Standard deviations 10 % and 20 % of the controls, 5 % of the range."""
    controls = np.tile([[0.1, 0.05], [-0.4, 0.3]], (150, 1))
    scenario = world(
        controls=controls,
        motion=motion.Increment(lambda pose, u: jnp.diag(jnp.array([0.1, 0.2]) * u) ** 2),
        sensor=sensors.RangeBearing(
            lambda z: jnp.diag(jnp.stack([0.05 * z[0], 0.01 * jnp.ones_like(z[0])])) ** 2,
            mount=MOUNT,
        ),
    )
    truth, log = draw(scenario, runs=10)
    noise = motion_noise(scenario, truth, log)
    assert_standard_normal(noise / np.abs(controls * [0.1, 0.2]))
    exact = exact_measurements(truth.pose)[..., 0]
    sigma = np.stack([0.05 * exact, np.full(exact.shape, 0.01)], axis=-1)
    assert_standard_normal(measurement_noise(truth, log) / sigma)


@pytest.mark.parametrize("noise_on", ["robot", "odometry"])
def test_no_noise_is_the_nominal_world(noise_on):
    scenario = world(
        40,
        motion=motion.Increment(np.zeros((2, 2))),
        sensor=sensors.RangeBearing(np.zeros((2, 2)), mount=MOUNT),
        noise_on=noise_on,
    )
    truth, log = draw(scenario)
    path = nominal_path(scenario)
    np.testing.assert_allclose(truth.pose[:, :2], path[:, :2], atol=1e-13)
    np.testing.assert_allclose(wrap(truth.pose[:, 2] - path[:, 2]), 0, atol=1e-13)
    np.testing.assert_array_equal(log.control, scenario.controls)
    np.testing.assert_allclose(log.scan.z, exact_measurements(path), atol=1e-12)
    np.testing.assert_array_equal(truth.landmarks, LANDMARKS)


# --- keys ---------------------------------------------------------------------------------------


def test_a_key_determines_the_world_and_vmap_is_a_loop():
    scenario = world(40)
    keys = jax.random.split(jax.random.key(0), 2)
    first, again, second = (jax.device_get(simulate(scenario, keys[i])) for i in (0, 0, 1))
    mapped = jax.device_get(jax.jit(jax.vmap(functools.partial(simulate, scenario)))(keys))
    chex.assert_trees_all_equal(first, again)
    looped = jax.tree.map(lambda *leaves: np.stack(leaves), first, second)
    chex.assert_trees_all_close(mapped, looped, atol=1e-12, rtol=1e-7)
    assert np.abs(first[1].scan.z - second[1].scan.z).min() > 0
    assert np.abs(first[0].pose - second[0].pose).min() > 0


@pytest.mark.parametrize("noise_on", ["robot", "odometry"])
def test_no_key_is_used_twice(noise_on):
    scenario = world(10, noise_on=noise_on)
    with jax.debug_key_reuse(True):
        jax.jit(functools.partial(simulate, scenario))(jax.random.key(0))

        def careless(key):
            return jax.random.normal(key) + jax.random.normal(key)

        with pytest.raises(jax.errors.KeyReuseError):
            jax.jit(careless)(jax.random.key(0))


def test_filters_get_the_precision_jax_is_set_to():
    scenario = world(10)
    off = jax.enable_x64 if hasattr(jax, "enable_x64") else jax.experimental.enable_x64
    key = jax.random.key(0)
    for on, kind in ((False, np.float32), (True, np.float64)):
        with off(on):
            out = jax.eval_shape(functools.partial(simulate, scenario), key)
        leaves = [a.dtype for a in jax.tree.leaves(out) if jnp.issubdtype(a.dtype, jnp.floating)]
        assert set(leaves) == {np.dtype(kind)}


# --- what is in view ----------------------------------------------------------------------------


@pytest.mark.parametrize("places", [2, 9])
def test_a_scan_holds_what_is_in_view_lowest_tags_first(places):
    near = BetweenRanges(1.0, 4.0)
    controls = np.tile([0.15, 0.05], (100, 1))
    scenario = world(controls=controls, visible=near, places=places)
    truth, log = draw(scenario)
    room = min(places, len(LANDMARKS))
    assert log.scan.z.shape == (100, room, 2)
    distance = np.linalg.norm(truth.pose[:, None, :2] - LANDMARKS, axis=2)
    exact, counts = exact_measurements(truth.pose), set()
    for t in range(100):
        seen = np.flatnonzero((distance[t] > 1) & (distance[t] < 4))
        counts.add(len(seen))
        valid = log.scan.valid[t]
        tags = log.scan.tag[t]
        np.testing.assert_array_equal(tags[valid], seen[:room])
        np.testing.assert_array_equal(tags[~valid], -1)
        assert not log.scan.z[t][~valid].any()
        assert truth.missed[t] == len(seen) - min(len(seen), room)
        noise = log.scan.z[t][valid] - exact[t, tags[valid]]
        noise[:, 1] = wrap(noise[:, 1])
        assert np.all(np.abs(whiten(noise, R)) < 6)
    assert len(counts) > 2  # more and fewer landmarks in view than places
    reckoning = filters.DeadReckoning(scenario.motion, scenario.sensor)
    start = scenario.pose, scenario.pose_cov
    jax.eval_shape(lambda key: run(reckoning, log, *start, key), jax.random.key(0))  # is accepted


def test_everything_is_in_view_by_default():
    truth, log = draw(world(40))
    assert log.scan.valid.all()
    np.testing.assert_array_equal(log.scan.tag, np.tile(np.arange(5), (40, 1)))
    assert not truth.missed.any()


def test_BetweenRanges_excludes_both_ends_and_reads_the_position_alone():
    visible = BetweenRanges(1.0, 2.0)
    pose = jnp.array([0.0, 0.0, 1.0])
    for x, expected in ((0.999, 0), (1.0, 0), (1.001, 1), (1.999, 1), (2.0, 0), (2.001, 0)):
        assert bool(visible(pose, jnp.array([0.0, x, 77.0]))) == expected


# --- scenarios ----------------------------------------------------------------------------------

BLIND = changed(motion.Increment(Q), perturb=None)


@refused(
    ({"landmarks": np.zeros((3, 3))}, "landmarks: expected shape"),
    ({"landmarks": np.zeros((0, 2))}, "landmarks: expected shape"),
    ({"landmarks": [[0.0, np.nan]]}, "landmarks: expected finite"),
    ({"controls": np.zeros((5, 3))}, "controls: expected shape"),
    ({"controls": np.zeros((0, 2))}, "controls: expected shape"),
    ({"controls": np.zeros(2)}, "controls: expected shape"),
    ({"controls": [[0.0, np.inf]]}, "controls: expected finite"),
    ({"controls": [["a", "b"]]}, "controls: expected finite"),
    ({"pose": (0.0, 0.0)}, "pose: expected finite numbers of shape"),
    ({"pose": (0.0, 0.0, np.nan)}, "pose: expected finite"),
    ({"pose_cov": np.eye(2)}, "pose_cov: expected a covariance"),
    ({"pose_cov": -np.eye(3)}, "pose_cov: .*positive semi-definite"),
    ({"noise_on": "map"}, 'noise_on: expected "robot" or'),
    ({"motion": sensors.RangeBearing(R)}, "motion: expected a Motion"),
    ({"motion": BLIND, "noise_on": "odometry"}, "motion: expected one with `perturb`"),
    ({"places": 0}, "places: expected an integer >= 1"),
    ({"places": -2}, "places: expected an integer >= 1"),
    told="^Scenario: ",
)
def test_inconsistent_scenarios_are_refused(changes):
    world(**changes)


def test_a_motion_without_perturb_may_move_the_robot():
    assert world(10, motion=BLIND).steps == 10


@pytest.mark.parametrize("name", SCENARIOS)
def test_named_scenarios(name):
    scenario = SCENARIOS[name](7)
    assert scenario.name == name
    assert scenario.steps == 7
    assert scenario.source
    for bad in (0, -1, 2.5):
        with pytest.raises(ValueError, match="steps"):
            SCENARIOS[name](bad)


def test_circle_is_the_published_benchmark():
    """UKF-M: v = 0.25 m/s, 1.5 °/s, 20 landmarks 3 m outside the path, seen between 1 and 5 m."""
    scenario = circle(2500)
    truth, log = draw(scenario)
    radius = 0.25 / np.deg2rad(1.5)
    landmarks = np.asarray(scenario.landmarks)
    assert landmarks.shape == (20, 2)
    np.testing.assert_allclose(np.hypot(*(landmarks - [0, radius]).T), radius + 3, rtol=1e-12)
    around = np.sort(np.arctan2(landmarks[:, 1] - radius, landmarks[:, 0]))
    np.testing.assert_allclose(np.diff(around), 2 * np.pi / 20, atol=1e-12)
    # The path: a closed polygon of 240 chords about nearly that centre, inside the ring.
    turn = truth.pose[:240]
    centre = turn[:, :2].mean(axis=0)
    np.testing.assert_allclose(centre, [0, radius], atol=0.13)
    np.testing.assert_allclose(turn[-1], [0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(np.hypot(*(turn[:, :2] - centre).T), radius, rtol=1e-3)
    np.testing.assert_allclose(truth.pose[240:480, :2], turn[:, :2], atol=1e-9)
    # Every landmark in view has a place, and all get seen.
    assert not truth.missed.any()
    distance = np.linalg.norm(truth.pose[:, None, :2] - landmarks, axis=2)
    seen = (distance > 1) & (distance < 5)
    np.testing.assert_array_equal(seen.sum(axis=1), log.scan.valid.sum(axis=1))
    assert seen.any(axis=0).all()
    assert log.scan.z.shape[1] == seen.sum(axis=1).max()  # and no place is idle throughout
    # Noise of the odometry and of the positions, against the figures of the program.
    w = (log.control - scenario.controls)[:, :2]
    assert_standard_normal(w / (0.05 * 0.25 * np.array([1 / np.sqrt(2), 2 * np.sqrt(2)])))
    np.testing.assert_array_equal(log.control[:, 2], 1)
    ahead = to_frame(truth.pose[:, None], landmarks[log.scan.tag])
    assert_standard_normal((log.scan.z - ahead)[log.scan.valid] / 0.1)
    assert not np.any(scenario.pose)
    assert not np.any(scenario.pose_cov)


@pytest.mark.parametrize("steps", [1, 30, 500])
def test_circle_has_a_place_for_every_landmark_in_view_at_any_length(steps):
    scenario = circle(steps)
    controls = np.asarray(scenario.controls)[:, :2]
    path = nominal_path(
        dataclasses.replace(scenario, controls=controls, motion=motion.Increment(Q))
    )
    distance = np.linalg.norm(path[:, None, :2] - np.asarray(scenario.landmarks), axis=2)
    assert ((distance > 1) & (distance < 5)).sum(axis=1).max() == scenario.places


def test_cloister_is_the_guides_simulation():
    """Solà C.3: 36 columns with the symmetry of a square; the path is a circle about the centre."""
    scenario = cloister(200)
    landmarks = np.asarray(scenario.landmarks)
    assert landmarks.shape == (36, 2)
    np.testing.assert_allclose([landmarks.min(0), landmarks.max(0)], [[-4, -4], [4, 4]], atol=1e-12)

    def as_set(points):
        return {tuple(p) for p in np.round(points, 9) + 0.0}

    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
    assert len(as_set(landmarks)) == 36
    assert as_set(landmarks @ quarter.T) == as_set(landmarks)
    assert as_set(landmarks * [-1, 1]) == as_set(landmarks)
    # An outer row along each wall, an inner one a spacing of 4/3 m before it.
    assert np.sum(np.isclose(landmarks[:, 1], 4)) == 5
    assert np.sum(np.isclose(np.abs(landmarks).max(axis=1), 4)) == 20
    assert np.sum(np.isclose(np.abs(landmarks).max(axis=1), 8 / 3)) == 16
    # The robot walks around inside: one turn is 2π/0.05 steps of 0.1 m, a circle of radius 2 m.
    path = nominal_path(dataclasses.replace(scenario, controls=np.tile([0.1, 0.05], (126, 1))))
    np.testing.assert_allclose(np.hypot(*path[:, :2].T), 2, atol=0.06)
    np.testing.assert_allclose(
        scenario.motion.noise_cov(jnp.zeros(3), jnp.zeros(2)), np.diag([1e-4, 4e-4])
    )
    z_cov = np.diag([0.01, np.deg2rad(1) ** 2])
    np.testing.assert_allclose(scenario.sensor.noise_cov(jnp.zeros(2)), z_cov)
    assert scenario.noise_on == "robot"
    gate = sigma_gate(3, 2)
    assert scenario.filter_options == {"correction": "sequential", "gate": gate, "births": 1}


@pytest.mark.parametrize("n", [4, 7, 9])
def test_cloister_landmarks_fill_their_bounds(n):
    points = cloister_landmarks(-1.0, 5.0, n)
    assert points.shape == (4 * (2 * n - 5), 2)
    np.testing.assert_allclose([points.min(0), points.max(0)], [[-1, -1], [5, 5]], atol=1e-12)
    assert len({tuple(p) for p in np.round(points, 9)}) == len(points)
