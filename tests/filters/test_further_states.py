"""Robots whose state has more than a pose: velocities, biases and scales, and sensors of them."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import refused, swept
from worlds import draw, ring

from jaxslam import (
    Scenario,
    catalog,
    charts,
    graphs,
    linearize,
    monte_carlo,
    motion,
    run,
    sensors,
)
from jaxslam.consistency import conditional_bound
from jaxslam.core.protocols import POSE, Motion
from jaxslam.core.record import record
from jaxslam.core.types import Status
from jaxslam.filters import (
    CompressedEkfSlam,
    DeadReckoning,
    EifSlam,
    EkfSlam,
    FastSlam,
    Localization,
    Merging,
    Monitored,
    ParticleLocalization,
    Seif,
)
from jaxslam.filters.multi_robot.team import Robot
from jaxslam.graphs.smoothing import BatchMap, FixedLag, Smoother
from jaxslam.sensors import Part, Suite

KEY = jax.random.key(0)


@record
class Rail(Motion):
    """A robot that does not turn: x by its velocity, y by a measured velocity with a bias. Linear."""

    noise_cov: object
    state = (*POSE, "v [m/s]", "bias [m/s]")
    controls = ("across [m/s]", "dt [s]")
    noises = ("across [m/s]", "a [m/s2]", "bias [m/s2]")

    def step(self, robot, u, w):
        x, y, theta, v, bias = robot
        dt = u[1]
        return jnp.stack(
            [
                x + v * dt,
                y + (u[0] + w[0] - bias) * dt,
                theta,
                v + w[1] * dt,
                bias + w[2] * dt,
            ]
        )


DT, Q = 0.1, np.diag([0.2, 0.5, 0.05]) ** 2
R_POINT, R_SPEED = np.diag([0.1, 0.15]) ** 2, np.array([[0.09]])
RAIL_START = np.array([0.5, -0.2, 0.0, 1.0, 0.1])
RAIL_COV = np.diag([0.1, 0.1, 0.0, 0.4, 0.2]) ** 2
POINTS = np.array([[3.0, 1.0], [-1.0, 4.0], [5.0, -2.0]])


@cache
def rail():
    """The linear world of velocity and bias, its truth and its log."""
    eyes = Suite(
        (
            Part(sensors.RelativePosition(R_POINT), 3),
            Part(sensors.Speed(R_SPEED), 1, interval=3),
        )
    )
    controls = np.stack([np.sin(np.arange(40) / 5), np.full(40, DT)], axis=1)
    world = Scenario("rail", Rail(Q), eyes, POINTS, controls, pose=RAIL_START, pose_cov=RAIL_COV)
    truth, log = draw(world, 0)
    return world, jax.device_get(truth), jax.device_get(log)


def kalman(log):
    """A Kalman filter of (x, y, v, b) and the points, in NumPy: means, covariances and log p."""
    f, g = np.eye(4), np.zeros((4, 3))
    f[0, 2], f[1, 3] = DT, -DT
    g[1, 0], g[2, 1], g[3, 2] = DT, DT, DT
    mean, cov = RAIL_START[[0, 1, 3, 4]], RAIL_COV[np.ix_([0, 1, 3, 4], [0, 1, 3, 4])]
    slot, log_p, means, covs = {}, 0.0, [], []
    for u, z, tag, valid in zip(log.control, *log.scan, strict=True):
        n = len(mean)
        a = np.eye(n)
        a[:4, :4] = f
        mean = a @ mean + np.r_[0, DT * u[0], np.zeros(n - 2)]
        cov = a @ cov @ a.T
        cov[:4, :4] += g @ Q @ g.T

        def correct(h, z, noise, mean, cov):
            s = h @ cov @ h.T + noise
            nu, gain = z - h @ mean, cov @ h.T @ np.linalg.inv(s)
            _, log_det = np.linalg.slogdet(2 * np.pi * s)
            p = -0.5 * (nu @ np.linalg.solve(s, nu) + log_det)
            return mean + gain @ nu, cov - gain @ s @ gain.T, p

        for k in range(3):
            if not valid[k]:
                continue
            if tag[k] in slot:
                h = np.zeros((2, len(mean)))
                h[:, :2], h[:, slot[tag[k]] : slot[tag[k]] + 2] = -np.eye(2), np.eye(2)
                mean, cov, p = correct(h, z[k], R_POINT, mean, cov)
                log_p += p
        for k in range(3):
            if valid[k] and tag[k] not in slot:
                slot[tag[k]] = len(mean)
                rows = cov[:2]
                cov = np.block([[cov, rows.T], [rows, cov[:2, :2] + R_POINT]])
                mean = np.r_[mean, mean[:2] + z[k]]
        if valid[3]:
            h = np.zeros((1, len(mean)))
            h[0, 2] = 1
            mean, cov, p = correct(h, z[3, :1], R_SPEED, mean, cov)
            log_p += p
        means.append(mean[:4])
        covs.append(cov[:4, :4])
    return np.array(means), np.array(covs), log_p


@pytest.mark.parametrize(
    "options",
    swept(
        ("sequential", "joint", "joseph", "square_root", "invariant"), "sequential", "square_root"
    ),
)
def test_a_linear_world_of_velocity_and_bias_is_a_kalman_filter(options):
    world, _, log = rail()
    chosen = {
        "sequential": {},
        "joint": {"correction": "joint"},
        "joseph": {"covariance": "joseph"},
        "square_root": {"covariance": "square_root"},
        # The heading is known, so that its errors are plain ones.
        "invariant": {"chart": charts.RightInvariant()},
    }[options]
    filter = EkfSlam(world.motion, world.sensor, 3, **chosen)
    trace = jax.device_get(run(filter, log, RAIL_START, RAIL_COV, KEY))
    means, covs, log_p = kalman(log)
    estimate = trace.estimate
    np.testing.assert_allclose(estimate.pose[:, :2], means[:, :2], atol=1e-10)
    np.testing.assert_allclose(estimate.further, means[:, 2:], atol=1e-10)
    np.testing.assert_allclose(estimate.pose_cov[:, :2, :2], covs[:, :2, :2], atol=1e-10)
    np.testing.assert_allclose(estimate.further_cov, covs[:, 2:, 2:], atol=1e-10)
    np.testing.assert_allclose(trace.info.log_likelihood.sum(), log_p, rtol=1e-10)


def test_the_bound_of_a_linear_world_is_its_kalman_filter():
    world, truth, log = rail()
    bound = conditional_bound(world, truth, log, KEY)
    np.testing.assert_allclose(bound.further_cov, kalman(log)[1][:, 2:, 2:], atol=1e-10)


def test_the_truth_holds_the_further_states():
    world, truth, log = rail()
    assert truth.further.shape == (40, 2)
    assert truth.start.shape == (5,)
    speed = np.r_[truth.start[3], truth.further[:-1, 0]]
    np.testing.assert_allclose(
        np.diff(np.r_[truth.start[0], truth.pose[:, 0]]), DT * speed, atol=1e-12
    )
    measured = log.scan.valid[:, 3]
    off = (log.scan.z[:, 3, 0] - truth.further[:, 0])[measured]
    assert 0.15 < off.std() < 0.45  # R_SPEED is 0.3²


# --- a nonlinear world: a gyroscope with a bias and a wheel with a scale --------------------------

BIASED_START = np.array([0.1, -0.05, 0.02, 0.03, 1.05])
BIASED_COV = np.diag([0.1, 0.1, 0.05, 0.02, 0.05]) ** 2
DENSITY = (0.05, 0.02, 0.002, 0.005)


@cache
def biased(steps=40):
    scenario = ring(steps)
    controls = np.tile([1.0, 0.2, 0.2], (steps, 1))
    world = Scenario(
        "biased",
        motion.BiasedOdometry(motion.NoiseDensity(np.array(DENSITY))),
        sensors.RangeBearing(np.diag([0.1, 0.03]) ** 2),
        np.asarray(scenario.landmarks),
        controls,
        pose=BIASED_START,
        pose_cov=BIASED_COV,
    )
    truth, log = draw(world, 1)
    return world, jax.device_get(truth), jax.device_get(log)


def driven(filter, log, start=BIASED_START, cov=BIASED_COV):
    return jax.device_get(run(filter, log, start, cov, KEY))


def assert_same(a, b, tolerance):
    for name in ("pose", "pose_cov", "further", "further_cov", "points", "point_covs"):
        np.testing.assert_allclose(
            getattr(a.estimate, name), getattr(b.estimate, name), atol=tolerance, err_msg=name
        )


def step_in_numpy(x, u, w):
    """`BiasedOdometry` for complex numbers, whose imaginary part is a derivative."""
    arc, along = (u[1] + w[1] - x[3]) * u[2], x[4] * (u[0] + w[0]) * u[2]
    half = arc / 2
    chord = along * np.sin(half) / half
    heading = x[2] + half
    return np.array(
        [
            x[0] + chord * np.cos(heading),
            x[1] + chord * np.sin(heading),
            x[2] + arc,
            x[3] + w[2] * u[2],
            x[4] + w[3] * u[2],
        ]
    )


def derivative(f, x):
    """The Jacobian by complex steps, exact to rounding."""
    steps = 1e-30j * np.eye(len(x))
    return np.stack([f(x + step).imag / 1e-30 for step in steps], axis=1)


def test_localization_with_a_bias_is_an_ekf_in_numpy():
    world, _, log = biased()
    points = np.asarray(world.landmarks)
    noise = np.diag([0.1, 0.03]) ** 2
    mean, cov = BIASED_START.copy(), BIASED_COV.copy()
    means, covs = [], []
    for u, z, tag, valid in zip(log.control, *log.scan, strict=True):
        f = derivative(lambda x, u=u: step_in_numpy(x, u, np.zeros(4)), mean.astype(complex))
        g = derivative(lambda w, u=u, m=mean: step_in_numpy(m, u, w), np.zeros(4, complex))
        cov = f @ cov @ f.T + g @ np.diag(np.square(DENSITY) / u[2]) @ g.T
        mean = step_in_numpy(mean, u, np.zeros(4)).real
        for k in np.flatnonzero(valid):
            dx, dy = points[tag[k]] - mean[:2]
            r2 = dx**2 + dy**2
            r = np.sqrt(r2)
            nu = z[k] - [r, np.arctan2(dy, dx) - mean[2]]
            nu[1] = np.angle(np.exp(1j * nu[1]))
            h = np.zeros((2, 5))
            h[0, :2], h[1, :3] = [-dx / r, -dy / r], [dy / r2, -dx / r2, -1]
            s = h @ cov @ h.T + noise
            gain = cov @ h.T @ np.linalg.inv(s)
            mean, cov = mean + gain @ nu, cov - gain @ s @ gain.T
        means.append(mean)
        covs.append(cov)
    trace = driven(Localization(world.motion, world.sensor, points), log)
    means, covs = np.array(means), np.array(covs)
    off = trace.estimate.pose - means[:, :3]
    off[:, 2] = np.angle(np.exp(1j * off[:, 2]))
    np.testing.assert_allclose(off, 0, atol=1e-10)
    np.testing.assert_allclose(trace.estimate.further, means[:, 3:], atol=1e-10)
    np.testing.assert_allclose(trace.estimate.pose_cov, covs[:, :3, :3], atol=1e-10)
    np.testing.assert_allclose(trace.estimate.further_cov, covs[:, 3:, 3:], atol=1e-10)


@pytest.mark.parametrize(
    ("chart", "linearizer"),
    swept(
        [
            *((chart, "at_estimate") for chart in charts.REGISTRY),
            ("euclidean", "first_estimate"),
            ("euclidean", "observability"),
            ("euclidean", "unscented"),
            ("right_invariant", "unscented"),
        ],
        ("right_invariant", "at_estimate"),
        ("euclidean", "first_estimate"),
    ),
)
def test_further_states_that_are_known_change_nothing(chart, linearizer):
    """With bias 0 and scale 1 known it is the filter of the pose alone, in every form."""
    world, _, log = biased()
    options = {
        "chart": charts.REGISTRY[chart](),
        "linearize": {
            "at_estimate": linearize.AtEstimate(),
            "first_estimate": linearize.FirstEstimate(),
            "observability": linearize.Observability(),
            "unscented": linearize.Unscented(),
        }[linearizer],
    }
    noise = np.diag(np.square(DENSITY[:2])) / 0.2
    whole = motion.BiasedOdometry(np.pad(noise, [(0, 2), (0, 2)]))
    plain = motion.Velocity(np.pad(noise, [(0, 1), (0, 1)]))
    filters = [EkfSlam(m, world.sensor, len(world.landmarks), **options) for m in (whole, plain)]
    start, cov = np.r_[BIASED_START[:3], 0, 1], np.pad(BIASED_COV[:3, :3], [(0, 2), (0, 2)])
    wide = driven(filters[0], log, start, cov)
    narrow = driven(filters[1], log, start[:3], cov[:3, :3])
    np.testing.assert_allclose(wide.estimate.further, np.tile([0, 1], (40, 1)), atol=1e-12)
    # Sigma points of more numbers reach farther, by their square root.
    tolerance = 1e-4 if linearizer == "unscented" else 1e-10
    for name in ("pose", "pose_cov", "points", "point_covs"):
        a, b = (getattr(trace.estimate, name) for trace in (wide, narrow))
        np.testing.assert_allclose(a, b, atol=tolerance, err_msg=name)


@pytest.mark.parametrize("form", swept(("joseph", "square_root", "eif"), "square_root"))
def test_forms_of_the_covariance_agree(form):
    world, _, log = biased()
    joint = {"correction": "joint"}
    plain = driven(EkfSlam(world.motion, world.sensor, len(world.landmarks), **joint), log)
    models = world.motion, world.sensor, len(world.landmarks)
    other = EifSlam(*models) if form == "eif" else EkfSlam(*models, **joint, covariance=form)
    assert_same(driven(other, log), plain, 1e-8)


def test_one_sigma_of_the_iterated_filter_is_the_plain_one():
    """With exact measurements at the estimate, a second pass changes nothing."""
    world, _, log = biased()
    models = world.motion, world.sensor, len(world.landmarks)
    once, thrice = (
        driven(EkfSlam(*models, chart=charts.RightInvariant(), iterations=n), log) for n in (1, 3)
    )
    assert np.isfinite(thrice.estimate.further).all()
    gap = np.abs(once.estimate.further - thrice.estimate.further).max()
    assert 1e-9 < gap < 0.01


def test_the_smoother_ends_where_the_filter_does():
    world, truth, log = biased()
    models = world.motion, world.sensor, len(world.landmarks)
    filtered = driven(EkfSlam(*models, correction="joint"), log)
    smoothed = jax.device_get(Smoother(*models, BIASED_START, BIASED_COV)(log, KEY))
    for name in ("pose", "pose_cov", "further", "further_cov"):
        a, b = (getattr(trace.estimate, name)[-1] for trace in (smoothed, filtered))
        np.testing.assert_allclose(a, b, atol=1e-9, err_msg=name)
    # Earlier states have less variance than the filter's.
    variance = [np.diagonal(t.estimate.further_cov, axis1=1, axis2=2) for t in (smoothed, filtered)]
    assert np.all(variance[0] <= variance[1] + 1e-12)
    error = np.abs(smoothed.estimate.further - truth.further)
    assert np.all(error < 5 * np.sqrt(variance[0]))


@pytest.mark.sweep
def test_the_batch_lowers_the_cost_of_the_smoother():
    world, truth, log = biased()
    models = world.motion, world.sensor, len(world.landmarks)
    trace = jax.device_get(BatchMap(*models, BIASED_START, BIASED_COV)(log, KEY))
    costs = trace.final.costs
    assert np.all(np.diff(costs) <= 1e-9 * costs[0])
    sigma = np.sqrt(np.diagonal(trace.estimate.further_cov, axis1=1, axis2=2))
    assert np.all(np.abs(trace.estimate.further - truth.further) < 5 * sigma)


@pytest.mark.parametrize(("speed", "expected"), [(1.0, 3), (0.0, 4)])
def test_how_many_directions_stay_unobservable(speed, expected):
    """Three in SLAM; and the scale of a robot that does not move."""
    world, _, _ = biased()
    world = replace(world, controls=np.tile([speed, 0.2, 0.2], (20, 1)))
    still = motion.BiasedOdometry(np.zeros((4, 4)))
    world = replace(world, motion=still, pose_cov=np.zeros((5, 5)))
    filters = {
        "ideal": lambda truth: Monitored(
            EkfSlam(
                world.motion,
                world.sensor,
                len(world.landmarks),
                linearize=linearize.AtTruth(truth),
            )
        )
    }
    campaign = monte_carlo(world, filters, runs=2, key=KEY)
    assert campaign.filters["ideal"].measures["unobservable"].value == expected


def test_the_gradient_by_the_noise_of_the_bias_is_that_of_differences():
    world, _, log = biased(20)
    capacity = len(world.landmarks)

    @jax.jit
    def log_likelihood(sigma):
        density = jnp.asarray(DENSITY).at[2].set(sigma)
        model = motion.BiasedOdometry(motion.NoiseDensity(density))
        filter = EkfSlam(model, world.sensor, capacity)
        return run(filter, log, BIASED_START, BIASED_COV, KEY).info.log_likelihood.sum()

    slope, h = jax.grad(log_likelihood)(0.01), 1e-5
    difference = (log_likelihood(0.01 + h) - log_likelihood(0.01 - h)) / (2 * h)
    np.testing.assert_allclose(slope, difference, rtol=1e-6)


def test_a_filter_without_the_states_is_optimistic_and_one_with_them_is_not():
    world, _, _ = biased(60)
    density = np.array([0.05, 0.005, 0.002, 0.005])
    world = replace(
        world,
        motion=motion.BiasedOdometry(motion.NoiseDensity(density)),
        pose_cov=np.diag([0.1, 0.1, 0.05, 0.06, 0.05]) ** 2,
    )
    chart = charts.RightInvariant()
    capacity = len(world.landmarks)
    plain = motion.Velocity(np.diag([*np.square(density[:2]) / 0.2, 0]))
    filters = {
        "with": EkfSlam(world.motion, world.sensor, capacity, chart=chart),
        "without": EkfSlam(plain, world.sensor, capacity, chart=chart),
        "reckoned": DeadReckoning(world.motion, world.sensor),
    }
    campaign = monte_carlo(world, filters, runs=50, key=KEY)
    measures = {name: campaign.filters[name].measures for name in filters}
    for name in ("with", "reckoned"):
        for key in ("nees_of_bias", "nees_of_scale", "nees_further"):
            assert 0.65 < measures[name][key].value < 1.5, (name, key)
    assert 2.4 < measures["with"]["nees_pose"].value < 3.9
    assert measures["without"]["nees_pose"].value > 6
    assert "nees_of_bias" not in measures["without"]
    assert "bias NEES" in str(campaign)


def test_float32_has_finite_numbers_close_to_those_of_float64():
    world, _, log = biased()
    filter = EkfSlam(world.motion, world.sensor, len(world.landmarks), correction="joint")
    single = jax.tree.map(
        lambda leaf: leaf.astype(np.float32) if leaf.dtype == float else leaf, log
    )
    narrow, wide = driven(filter, single), driven(filter, log)
    assert narrow.estimate.further.dtype == np.float32
    np.testing.assert_allclose(narrow.estimate.further, wide.estimate.further, atol=2e-3)


# --- sensors of velocities, and parameters as states ----------------------------------------------


@pytest.mark.parametrize("mount", [None, (0.4, -0.3, 0.9)])
@pytest.mark.parametrize(("kind", "entry"), [(sensors.RangeRate, 0), (sensors.BearingRate, 1)])
def test_a_rate_is_that_of_the_moving_robot(kind, entry, mount):
    """Of ranges, or of bearings, by differences of NumPy from the robot's velocities."""
    sensor = kind(np.eye(3), mount=mount)
    robot, landmark = np.array([1.0, 2.0, 0.7, 0.8, -0.5]), np.array([3.0, -1.0])

    def seen_at(t):
        heading = robot[2] + robot[4] * t
        radius = robot[3] / robot[4]
        arc = np.array([np.sin(heading) - np.sin(robot[2]), np.cos(robot[2]) - np.cos(heading)])
        a, b, gamma = mount or (0.0, 0.0, 0.0)
        c, s = np.cos(heading), np.sin(heading)
        eye = robot[:2] + radius * arc + [c * a - s * b, s * a + c * b]
        gap = landmark - eye
        return np.array([np.hypot(*gap), np.arctan2(gap[1], gap[0]) - heading - gamma])

    h = 1e-5
    rate = (seen_at(h) - seen_at(-h))[entry] / (2 * h)
    asked = robot[: 3 + len(sensor.robot)]
    np.testing.assert_allclose(sensor.observe(asked, landmark)[2], rate, rtol=1e-8)


def test_a_landmark_at_the_sensor_has_the_turn_rate_and_finite_derivatives():
    """The derivatives are those that JAX finds elsewhere, and zero by the landmark there."""
    sensor = sensors.BearingRate(np.eye(3), mount=(0.4, 0.0, 0.0))
    robot, at_sensor = jnp.array([0.0, 0.0, 0.0, 0.8, -0.5]), jnp.array([0.4, 0.0])
    np.testing.assert_array_equal(sensor.observe(robot, at_sensor), [0.0, 0.0, 0.5])
    for derive in (jax.jacfwd, jax.jacrev):
        by_robot, by_landmark = derive(sensor.observe, argnums=(0, 1))(robot, at_sensor)
        np.testing.assert_array_equal(by_robot[2], [0.0, 0.0, 0.0, 0.0, -1.0])
        np.testing.assert_array_equal(by_landmark, 0.0)
    exact = sensor.observe_jacobians(robot, at_sensor)
    assert all(np.isfinite(part).all() for part in exact)
    np.testing.assert_array_equal(exact[1], 0.0)


def test_velocities_are_found_without_odometry():
    """By Doppler, speedometer and gyroscope; a radar with the range rate knows its speed better."""
    landmarks = 3 * np.asarray(ring(1).landmarks)
    model = motion.ConstantVelocity(motion.NoiseDensity(np.array([0.3, 0.2])))
    noise = np.diag([0.3, 0.03, 0.05]) ** 2
    start, cov = np.array([0.0, 0, 0, 1, 0.2]), np.diag([0, 0, 0, 0.5, 0.2]) ** 2
    world = Scenario(
        "radar",
        model,
        sensors.RangeRate(noise),
        landmarks,
        np.full((60, 1), 0.1),
        pose=start,
        pose_cov=cov,
    )
    truth, log = draw(world, 0)
    plain = log._replace(scan=log.scan._replace(z=log.scan.z[..., :2]))
    doppler = Localization(model, world.sensor, landmarks)
    radar = Localization(model, sensors.RangeBearing(noise[:2, :2]), landmarks)
    with_rate, without = driven(doppler, log, start, cov), driven(radar, plain, start, cov)
    error = [
        np.sqrt(np.mean((t.estimate.further[:, 0] - truth.further[:, 0]) ** 2))
        for t in (with_rate, without)
    ]
    assert error[0] < 0.5 * error[1]
    eyes = Suite((Part(sensors.Speed(np.eye(1) / 100), 1), Part(sensors.TurnRate(np.eye(1)), 1)))
    blind = replace(world, sensor=eyes, landmarks=np.zeros((1, 0)))
    truth, log = draw(blind, 0)
    trace = driven(DeadReckoning(model, eyes), log, start, cov)
    seen = driven(EkfSlam(model, eyes, 1), log, start, cov)
    variance = [t.estimate.further_cov[-1] for t in (seen, trace)]
    assert np.all(np.diag(variance[0]) < np.diag(variance[1]))


def test_mapping_is_given_the_velocity_with_the_pose():
    """The map of a Doppler sensor on the true path is as near as that of ranges and bearings."""
    landmarks, noise = np.asarray(ring(1).landmarks), np.diag([0.1, 0.03, 0.05]) ** 2
    model = motion.ConstantVelocity(np.diag([0.3, 0.2]) ** 2)
    start, controls = np.array([0.0, 0, 0, 1, 0.2]), np.full((20, 1), 0.1)
    sensor = sensors.RangeRate(noise)
    world = Scenario("m", model, sensor, landmarks, controls, pose=start, pose_cov=np.zeros((5, 5)))
    truth, log = draw(world, 0)
    method = catalog.ALL["mapping"](world)(truth)
    trace = jax.device_get(method(log, KEY))
    np.testing.assert_array_equal(trace.estimate.further[:, 0], truth.further[:, 0])
    final = jax.tree.map(lambda leaf: leaf[-1], trace.estimate)
    off = final.points - np.asarray(truth.landmarks)[final.tag]
    assert np.abs(off[final.alive]).max() < 0.2
    assert (np.asarray(trace.info.status) == Status.FUSED).any()


def test_a_parameter_as_a_state_is_the_model_with_that_parameter():
    inner = motion.Corrected(motion.Unicycle(np.diag([0.1, 0.05]) ** 2), scale=(1.0, 1.0))
    model = motion.Augmented(inner, "scale", noise=(0.01, 0.02))
    assert model.state == (*POSE, "scale 1 [1]", "scale 2 [1]")
    pose, u, w = np.array([1.0, 2.0, 0.3]), np.array([1.0, 0.4, 0.25]), np.array([0.1, -0.2])
    scale, walk = np.array([1.1, 0.9]), np.array([0.03, 0.05])
    after = model.step(jnp.asarray(np.r_[pose, scale]), u, jnp.asarray(np.r_[w, walk]))
    of_scale = replace(inner, scale=scale)
    np.testing.assert_allclose(after[:3], of_scale.step(jnp.asarray(pose), u, w), rtol=1e-15)
    np.testing.assert_allclose(after[3:], scale + walk, rtol=1e-15)
    cov = model.noise_cov(jnp.asarray(np.r_[pose, scale]), jnp.asarray(u))
    np.testing.assert_allclose(np.diag(cov)[2:], 0.25 * np.array([0.01, 0.02]) ** 2)
    # Substeps carry the further states along.
    twice = motion.Substeps(model, 2)
    both = twice.step(np.r_[pose, scale], np.r_[u, u], np.zeros(8))
    once = model.step(jnp.asarray(np.r_[pose, scale]), u, jnp.zeros(4))
    np.testing.assert_allclose(both, model.step(once, u, jnp.zeros(4)), rtol=1e-14)


def test_two_sensors_of_a_suite_and_other_orders_of_the_state():
    """A sensor is given what it asks for, wherever the model has it."""

    @record
    class Turned(motion.ConstantVelocity):
        """The velocities in the other order."""

        state = (*POSE, "omega [rad/s]", "v [m/s]")

        def step(self, robot, u, w):
            order = np.array([0, 1, 2, 4, 3])
            return super().step(robot[order], u, w)[order]

    landmarks = np.asarray(ring(1).landmarks)
    noise = np.diag([0.3, 0.03, 0.05]) ** 2
    sensor = sensors.RangeRate(noise, mount=(0.4, -0.3, 0.9))
    accelerations = np.diag([0.3, 0.2]) ** 2
    start, cov = np.array([0.0, 0, 0, 1, 0.2]), np.diag([0.1, 0.1, 0.1, 0.5, 0.2]) ** 2
    order = np.array([0, 1, 2, 4, 3])
    model = motion.ConstantVelocity(accelerations)
    controls = np.full((20, 1), 0.1)
    world = Scenario("r", model, sensor, landmarks, controls, pose=start, pose_cov=cov)
    _, log = draw(world, 0)
    one = driven(EkfSlam(model, sensor, len(landmarks)), log, start, cov)
    turned = EkfSlam(Turned(accelerations), sensor, len(landmarks))
    other = driven(turned, log, start[order], cov[order][:, order])
    np.testing.assert_allclose(other.estimate.pose, one.estimate.pose, atol=1e-12)
    np.testing.assert_allclose(other.estimate.further[:, ::-1], one.estimate.further, atol=1e-12)


# --- what is refused -------------------------------------------------------------------------------

UNICYCLE, BIASED = motion.Unicycle(np.eye(2)), motion.BiasedOdometry(np.eye(4))
POINT_SENSOR, DOPPLER = sensors.RangeBearing(np.eye(2)), sensors.RangeRate(np.eye(3))


def own(state, result=5):
    @record
    class Mine(Motion):
        noise_cov: object
        controls = ("v [m/s]",)
        noises = ("v [m/s]",)

        def step(self, robot, u, w):
            return jnp.zeros(result, robot.dtype) + u + w

    Mine.state = state
    return Mine(np.eye(1))


@refused(
    (lambda: own((*POSE, "v")), "state: expected a unit of each number.*'v'"),
    (lambda: own((*POSE, "v [m/s]", "v [m/s]")), "state: expected the pose.*other names"),
    (lambda: own(("v [m/s]", *POSE)), "state: expected the pose"),
    (
        lambda: EkfSlam(own((*POSE, "v [m/s]"), 3), POINT_SENSOR, 3),
        r"mine\.step\(robot \(4,\).*return shape \(4,\), got shape \(3,\)",
    ),
    (
        lambda: EkfSlam(UNICYCLE, DOPPLER, 3),
        r"sensor: range_rate asks for v \[m/s\], the state of the motion has x \[m\]",
    ),
    (
        lambda: EkfSlam(UNICYCLE, Suite(((POINT_SENSOR, 2), (sensors.Speed(np.eye(1)), 1))), 3),
        r"sensor: speed asks for v \[m/s\]",
    ),
    (
        lambda: Scenario("w", UNICYCLE, DOPPLER, np.zeros((1, 2)), np.zeros((2, 3))),
        r"sensor: range_rate asks for v \[m/s\]",
    ),
    (
        lambda: Scenario("w", BIASED, POINT_SENSOR, np.zeros((1, 2)), np.zeros((2, 3))),
        r"pose: expected finite numbers of shape \(5,\)",
    ),
    (lambda: FastSlam(BIASED, POINT_SENSOR, 3, 10), "FastSlam: .*pose alone.*bias"),
    (lambda: Seif(BIASED, POINT_SENSOR, 3, active=2, links=2), "Seif: .*pose alone.*bias"),
    (lambda: FixedLag(BIASED, POINT_SENSOR, 3, 3, window=2), "FixedLag: .*pose alone.*bias"),
    (
        lambda: ParticleLocalization(BIASED, POINT_SENSOR, np.zeros((3, 2)), 10),
        "ParticleLocalization: .*pose alone.*bias",
    ),
    (
        lambda: CompressedEkfSlam(EkfSlam(BIASED, POINT_SENSOR, 3), 2),
        "CompressedEkfSlam: .*pose alone.*bias",
    ),
    (lambda: Merging(EkfSlam(BIASED, POINT_SENSOR, 3), 1.0), "Merging: .*pose alone.*bias"),
    (
        lambda: Robot(BIASED, Suite(((POINT_SENSOR, 3),))),
        "Robot: motion: expected a model whose state is the pose",
    ),
    (lambda: graphs.FromMotion(BIASED), "FromMotion: motion: expected a model whose state"),
    (lambda: graphs.FromSensor(DOPPLER), "FromSensor: sensor: range_rate asks for v"),
    (lambda: motion.Augmented(UNICYCLE, "scale", noise=0.1), "parameter: expected a field of"),
    (lambda: motion.Augmented(UNICYCLE, "noise_cov", noise=0.1), "parameter: expected a field"),
    (
        lambda: motion.Augmented(motion.Corrected(UNICYCLE), "scale", noise=(0.1, 0.2, 0.3)),
        r"noise: expected finite numbers of shape \(2,\)",
    ),
)
def test_refusals(case):
    case()


def test_a_filter_that_asks_for_a_state_the_world_has_not_is_refused():
    world = replace(ring(5), motion=UNICYCLE, controls=np.ones((5, 3)))
    filter = EkfSlam(BIASED, POINT_SENSOR, 3)
    with pytest.raises(ValueError, match=r"it estimates bias \[rad/s\], scale \[1\]") as caught:
        monte_carlo(world, {"mine": filter}, runs=2, key=KEY)
    assert "\n" not in str(caught.value)
