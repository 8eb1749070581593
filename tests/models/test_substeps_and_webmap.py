"""substeps is its model in a loop; webmap is the car it says, on a closed path of its own."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from own_models import changed
from reference.plane import to_frame

from jaxslam import motion, run, simulate
from jaxslam.filters import EkfSlam
from jaxslam.motion import Substeps
from jaxslam.simulation.scenarios import webmap

Q = np.array([[0.04, 0.003], [0.003, 0.01]])
COUNT = 3
# name: the model, and (n, U) controls of it
MODELS = {
    "ackermann": (
        motion.Ackermann(Q, wheelbase=2.0, sensor=(1.0, 0.3), encoder=0.2),
        [[1.0, 0.3, 0.4], [2.0, -0.5, 0.3], [1.5, 0.0, 0.7]],
    ),
    # its covariance depends on the control, and has another size than the control's
    "velocity": (
        motion.Velocity(motion.VelocityNoise(np.full(6, 0.1))),
        [[1.0, 0.3, 0.4], [2.0, -0.5, 0.3], [1.5, 0.0, 0.7]],
    ),
    # its covariance depends on the pose
    "increment": (
        motion.Increment(lambda pose, u: jnp.diag(jnp.stack([1 + pose[0] ** 2, 0.1 + u[1] ** 2]))),
        [[1.0, 0.3], [2.0, -0.5], [1.5, 0.0]],
    ),
}


@pytest.fixture(scope="module", params=MODELS)
def case(request):
    """The single model, the model of substeps, a pose, controls (n, U) and noises (n, W)."""
    single, u = MODELS[request.param]
    w = 0.1 * np.random.default_rng(0).normal(size=(COUNT, len(single.noises)))
    return single, Substeps(single, COUNT), np.array([1.0, -2.0, 3.0]), np.array(u), w


def test_substeps_is_the_loop_of_single_steps_with_its_noise_and_jacobians(case):
    """The covariance is the model's own along the nominal path; hand Jacobians are the chain rule."""
    single, whole, pose, u, w = case
    one = jax.jit(lambda pose, u, w: (single.step(pose, u, w), single.noise_cov(pose, u)))
    size = w.shape[1]
    moved, nominal, expected = pose, pose, np.zeros((w.size, w.size))
    for k in range(COUNT):
        block = slice(k * size, (k + 1) * size)
        moved, _ = one(moved, u[k], w[k])
        nominal, expected[block, block] = one(nominal, u[k], np.zeros(size))

    def everything(*arguments):
        by_autodiff = jax.jacfwd(whole.step, argnums=(0, 1, 2))(*arguments)
        noise = whole.noise_cov(*arguments[:2])
        return whole.step(*arguments), noise, whole.jacobians(*arguments), by_autodiff

    step, noise, by_hand, by_autodiff = jax.jit(everything)(pose, u.ravel(), w.ravel())
    np.testing.assert_allclose(step, moved, rtol=0, atol=1e-14)
    assert np.all(np.diagonal(expected) > 0)
    np.testing.assert_allclose(noise, expected, rtol=1e-14, atol=0)
    assert [part.shape for part in by_hand] == [(3, n) for n in (3, u.size, w.size)]
    chex.assert_trees_all_close(by_hand, by_autodiff, rtol=0, atol=1e-13)


def test_perturbed_controls_move_as_the_noise_does():
    single, u = MODELS["ackermann"]
    whole, pose, u = Substeps(single, COUNT), np.array([1.0, -2.0, 3.0]), np.ravel(u)
    w = 0.1 * np.random.default_rng(1).normal(size=2 * COUNT)
    assert whole.perturb is not None
    moved = np.asarray(jax.jit(whole.perturb)(u, w))
    assert np.any(moved != u)
    step = jax.jit(whole.step)
    np.testing.assert_array_equal(step(pose, moved, 0 * w), step(pose, u, w))


def test_what_the_model_lacks_substeps_lack():
    bare = changed(MODELS["ackermann"][0], perturb=None, jacobians=None)
    whole = Substeps(bare, 2)
    assert whole.perturb is None and whole.jacobians is None
    assert Substeps(motion.Velocity(np.eye(3)), 2).perturb is None


def test_names_are_numbered_and_keep_their_units(case):
    single, whole, _, u, w = case
    assert len(whole.controls) == u.size and len(whole.noises) == w.size
    assert len(set(whole.controls)) == u.size and len(set(whole.noises)) == w.size
    for one, many in ((single.controls, whole.controls), (single.noises, whole.noises)):
        assert [n.rpartition(" ")[2] for n in many] == [n.rpartition(" ")[2] for n in one] * COUNT
    assert Substeps(MODELS["ackermann"][0], 2).noises == (
        *("v_e 1 [m/s]", "steering 1 [rad]"),
        *("v_e 2 [m/s]", "steering 2 [rad]"),
    )


def test_gradients_reach_the_models_parameters():
    def end(wheelbase):
        model = Substeps(motion.Ackermann(Q, wheelbase=wheelbase), COUNT)
        u = jnp.asarray(MODELS["ackermann"][1]).ravel()
        return jnp.sum(model.step(jnp.zeros(3), u, jnp.zeros(2 * COUNT)))

    lengths = np.array([2.0, 2.0 + 1e-6, 2.0 - 1e-6])
    (_, above, below), slope = jax.jit(jax.vmap(jax.value_and_grad(end)))(lengths)
    np.testing.assert_allclose(slope[0], (above - below) / 2e-6, rtol=1e-7)


@pytest.mark.parametrize("count", [0, -1, 2.0, True, None])
def test_a_bad_count_is_refused(count):
    with pytest.raises(ValueError, match="Substeps: count"):
        Substeps(MODELS["ackermann"][0], count)


# --- webmap -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scenario():
    return webmap()


@pytest.fixture(scope="module")
def drawn(scenario):
    return jax.device_get(simulate(scenario, jax.random.key(0)))


def fine_controls(scenario):
    """(8T, 3): speed, steering, interval."""
    return np.asarray(scenario.controls).reshape(-1, 3)


def test_controls_keep_the_cars_limits(scenario):
    speed, steering, interval = fine_controls(scenario).T
    assert len(speed) == 8 * scenario.steps
    np.testing.assert_array_equal(speed, 3)
    np.testing.assert_array_equal(interval, 0.025)
    assert np.abs(steering).max() <= np.deg2rad(30)
    rate = np.diff(steering, prepend=0) / interval
    assert np.abs(rate).max() <= np.deg2rad(20) * (1 + 1e-9)
    # and is limited by them: it is a car that cannot take every corner as it wants to
    assert np.abs(rate).max() >= np.deg2rad(20) * (1 - 1e-9)


def test_true_path_is_the_nominal_one_whatever_the_draw(scenario, drawn):
    """In plain NumPy: arcs of curvature tan α/4 m."""
    x, y, theta = np.asarray(scenario.pose)
    path = []
    for v, alpha, dt in fine_controls(scenario):
        turn = v * np.tan(alpha) / 4 * dt
        straight = v * dt * np.sinc(turn / (2 * np.pi))
        x, y = x + straight * np.cos(theta + turn / 2), y + straight * np.sin(theta + turn / 2)
        theta += turn
        path.append((x, y, theta))
    expected = np.array(path)[7::8]
    truth, log = drawn
    np.testing.assert_allclose(truth.pose[:, :2], expected[:, :2], rtol=0, atol=1e-9)
    turned = truth.pose[:, 2] - expected[:, 2]
    np.testing.assert_allclose(np.exp(1j * turned), 1, rtol=0, atol=1e-11)
    assert expected[-1, 2] - np.asarray(scenario.pose)[2] == pytest.approx(4 * np.pi, abs=0.2)


def test_odometry_and_measurements_have_the_published_noise(scenario, drawn):
    """Within five standard errors of the standard deviation, 5/√(2n), and of the mean, 5/√n."""
    truth, log = drawn
    speed, steering, interval = (log.control - scenario.controls).reshape(-1, 3).T
    np.testing.assert_array_equal(interval, 0)
    ahead = np.take_along_axis(
        to_frame(truth.pose[:, None], np.asarray(scenario.landmarks)),
        log.scan.tag[..., None],
        axis=1,
    )
    expected = np.stack([np.hypot(*ahead.T).T, np.arctan2(ahead[..., 1], ahead[..., 0])], axis=-1)
    distance, bearing = (log.scan.z - expected)[log.scan.valid].T
    for noise, sigma in (
        (speed, 0.3),
        (steering, np.deg2rad(3)),
        (distance, 0.1),
        (bearing, np.deg2rad(1)),
    ):
        assert abs(noise.mean()) < 5 * sigma / np.sqrt(len(noise))
        assert noise.std() == pytest.approx(sigma, rel=5 / np.sqrt(2 * len(noise)))
    white = speed[1:] @ speed[:-1] / len(speed) / 0.3**2  # from one substep to the next
    assert abs(white) < 5 / np.sqrt(len(speed))


def test_every_loop_ends_where_it_began(scenario, drawn):
    truth, _ = drawn
    start = np.asarray(scenario.pose)
    once = webmap(loops=1)
    for steps in (once.steps, scenario.steps):
        end = truth.pose[steps - 1]
        assert np.hypot(*(end - start)[:2]) < 2
        assert abs(np.angle(np.exp(1j * (end - start)[2]))) < 0.2
    assert abs(scenario.steps - 2 * once.steps) <= 2
    np.testing.assert_array_equal(once.controls, np.asarray(scenario.controls)[: once.steps])
    assert 250 < 0.6 * once.steps < 400
    assert np.all(np.ptp(truth.pose[:, :2], axis=0) < 150)


def test_scans_hold_all_that_is_near_and_ahead_and_nothing_else(scenario, drawn):
    truth, log = drawn
    assert not truth.missed.any()
    ahead = to_frame(truth.pose[:, None], np.asarray(scenario.landmarks))
    expected = (np.hypot(*ahead.T).T < 30) & (ahead[..., 0] > 0)
    seen = np.zeros_like(expected)
    rows, places = np.nonzero(log.scan.valid)
    seen[rows, log.scan.tag[rows, places]] = True
    np.testing.assert_array_equal(seen, expected)
    assert seen.sum() == log.scan.valid.sum()
    assert log.scan.z.shape[1] == scenario.places == expected.sum(axis=1).max()
    z = log.scan.z[log.scan.valid]
    assert z[:, 0].max() < 30 + 0.5 and np.abs(z[:, 1]).max() < np.deg2rad(90 + 5)


def test_every_landmark_is_seen_and_at_least_two_at_any_moment(drawn):
    _, log = drawn
    tags = log.scan.tag[log.scan.valid]
    half = log.scan.valid[: len(log.scan.valid) // 2]
    assert set(tags) == set(range(36))
    assert log.scan.valid.sum(axis=1).min() >= 2
    assert set(log.scan.tag[: len(half)][half]) == set(range(36))


def test_steps_may_be_given():
    short, long = webmap(7), webmap(700, loops=1)
    assert (short.name, short.steps, long.steps) == ("webmap", 7, 700)
    np.testing.assert_array_equal(short.controls, np.asarray(long.controls)[:7])
    assert np.asarray(short.controls).dtype == np.float64
    assert short.places <= long.places
    for bad in (0, -1, 2.5):
        with pytest.raises(ValueError, match="steps"):
            webmap(bad)
        with pytest.raises(ValueError, match="loops"):
            webmap(loops=bad)


@pytest.mark.sweep
def test_ekf_slam_runs_on_it():
    scenario = webmap(20)
    landmarks = np.asarray(scenario.landmarks)
    ekf = EkfSlam(scenario.motion, scenario.sensor, len(landmarks), **scenario.filter_options)
    truth, log = jax.device_get(simulate(scenario, jax.random.key(1)))
    trace = run(ekf, log, scenario.pose, scenario.pose_cov, jax.random.key(2))
    chex.assert_tree_all_finite((trace.estimate, trace.info))
    assert np.hypot(*(trace.estimate.pose - truth.pose)[-1, :2]) < 1
    assert trace.estimate.alive[-1].sum() == len(set(log.scan.tag[log.scan.valid].tolist()))
