"""What single sensors say, number by number, against formulas written again in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import refused
from reference.plane import from_frame, mounted, to_frame, wrap

import jaxslam
from jaxslam import Scenario, charts, filters, linearize, motion, run, sensors, simulate
from jaxslam.core.types import Scan
from jaxslam.filters import EkfSlam
from jaxslam.filters.map_management.relocalization import seen_points
from jaxslam.sensors._line import turn_to_positive_distance

MOUNT = np.array([0.4, -0.3, 0.9])
VARIANCE = np.array([[0.02**2]])


def sensor_frame(pose, mount=MOUNT):
    """t_S (C, 2) and θ_S (C,)."""
    frame = mounted(pose, mount)
    return frame[:, :2], frame[:, 2]


def bearing_of(v, theta):
    return wrap(np.arctan2(v[:, 1], v[:, 0]) - theta)


def draw(seed, count=40):
    rng = np.random.default_rng(seed)
    pose = np.concatenate([rng.normal(size=(count, 2)) * 3, rng.uniform(-4, 4, (count, 1))], axis=1)
    return rng, pose, pose[:, :2] + rng.normal(size=(count, 2)) * 5


def over(function):
    compiled = jax.jit(jax.vmap(function))
    return lambda *arguments: jax.device_get(compiled(*map(np.asarray, arguments)))


def all_slopes(sensor):
    """(pose, l) -> z and the derivatives of observe: by hand, forward, reverse; one compilation."""

    def every(pose, landmark):
        forward = jax.jacfwd(sensor.observe, argnums=(0, 1))(pose, landmark)
        reverse = jax.jacrev(sensor.observe, argnums=(0, 1))(pose, landmark)
        hand = sensor.observe_jacobians(pose, landmark)
        return sensor.observe(pose, landmark), (hand, forward, reverse)

    return over(every)


def residual_of(sensor, z, z_hat):
    return over(sensor.residual)(np.array([z], float), np.array([z_hat], float))[0]


def same_angle(a, b, atol=1e-11):
    np.testing.assert_allclose(wrap(np.asarray(a) - np.asarray(b)), 0, atol=atol)


# --- full and partial measurements of points ----------------------------------------------------


def test_a_mount_in_degrees_is_told():
    for made in (
        lambda: sensors.RangeBearing(np.eye(2), mount=(0.0, 0.0, 90.0)),
        lambda: sensors.RangeOnly(np.eye(1), mount=np.array([0.0, 0.0, -45.0])),
    ):
        with pytest.warns(UserWarning, match=r"heading of the mounting pose, -?\d+ rad, is beyond"):
            sensor = made()
        assert abs(sensor.mount[2]) > 40  # as it was given
    sensors.RangeBearing(np.eye(2), mount=(0.0, 0.0, -2 * np.pi))


def test_range_only():
    sensor = sensors.RangeOnly(VARIANCE, mount=MOUNT)
    rng, pose, point = draw(0)
    at, theta = sensor_frame(pose)
    z = np.hypot(*(point - at).T)[:, None]
    np.testing.assert_allclose(over(sensor.observe)(pose, point), z, rtol=1e-13)
    s = rng.uniform(-3, 3, (len(z), 1))
    heading = theta + s[:, 0]
    expected = at + z * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    np.testing.assert_allclose(over(sensor.invert)(pose, z, s), expected, atol=1e-12)
    # Ranges are not angles.
    assert residual_of(sensor, [9], [1]) == [8]


def test_bearing_only():
    sensor = sensors.BearingOnly(VARIANCE, mount=MOUNT)
    rng, pose, point = draw(1)
    at, theta = sensor_frame(pose)
    z = bearing_of(point - at, theta)[:, None]
    same_angle(over(sensor.observe)(pose, point), z)
    s = rng.uniform(0.1, 30, (len(z), 1))
    heading = theta + z[:, 0]
    expected = at + s * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    np.testing.assert_allclose(over(sensor.invert)(pose, z, s), expected, atol=1e-12)
    np.testing.assert_allclose(residual_of(sensor, [3], [-3]), [6 - 2 * np.pi], atol=1e-14)


@pytest.mark.parametrize("factory", [sensors.RangeOnly, sensors.BearingOnly])
def test_at_the_sensor_itself_a_partial_measurement_is_zero_with_zero_derivatives(factory):
    sensor = factory(VARIANCE)
    for leaf in jax.tree.leaves(all_slopes(sensor)([[1.0, 2.0, 0.5]], [[1.0, 2.0]])):
        assert not leaf.any()


def test_range_bearing_signature():
    sensor = sensors.RangeBearingSignature(np.eye(3), mount=MOUNT)
    rng, pose, point = draw(2)
    landmark = np.concatenate([point, rng.normal(size=(len(pose), 1)) * 7], axis=1)
    at, theta = sensor_frame(pose)
    seen = over(sensor.observe)(pose, landmark)
    np.testing.assert_allclose(seen[:, 0], np.hypot(*(point - at).T), rtol=1e-13)
    same_angle(seen[:, 1], bearing_of(point - at, theta))
    np.testing.assert_array_equal(seen[:, 2], landmark[:, 2])
    back = over(sensor.invert)(pose, seen, np.zeros((len(pose), 0)))
    np.testing.assert_allclose(back, landmark, atol=1e-12)
    np.testing.assert_array_equal(over(sensor.position)(landmark), point)
    started = over(sensor.embed)(pose, point)
    np.testing.assert_array_equal(started, np.concatenate([point, 0 * point[:, :1]], axis=1))
    # A signature is a number: it does not wrap, and does not mix with the others.
    gap = residual_of(sensor, [1, 3, 50], [3, -3, 10])
    np.testing.assert_allclose(gap, [-2, 6 - 2 * np.pi, 40], atol=1e-14)
    # At the sensor it is still seen, though nothing else is.
    z, slopes = all_slopes(sensor)(np.zeros((1, 3)), [[*MOUNT[:2], 4.0]])
    np.testing.assert_array_equal(z, [[0, 0, 4]])
    for by_pose, by_landmark in slopes:
        assert not by_pose.any()
        np.testing.assert_array_equal(by_landmark[0], np.diag([0.0, 0.0, 1.0]))


# --- absolute sensors ---------------------------------------------------------------------------


def test_compass():
    sensor = sensors.Compass(VARIANCE, mount=MOUNT)
    pose = draw(3)[1]
    none = np.zeros((len(pose), 0))
    z = over(sensor.observe)(pose, none)
    assert z.shape == (len(pose), 1) and np.all(np.abs(z) <= np.pi)
    same_angle(z[:, 0], pose[:, 2] + MOUNT[2])
    by_pose, _ = over(sensor.observe_jacobians)(pose, none)
    np.testing.assert_array_equal(by_pose, np.tile([0, 0, 1], (len(pose), 1, 1)))
    np.testing.assert_allclose(residual_of(sensor, [-3.1], [3.1]), [2 * np.pi - 6.2], atol=1e-14)


def test_position_fix():
    sensor = sensors.PositionFix(0.04 * np.eye(2), mount=MOUNT)
    pose = draw(4)[1]
    none = np.zeros((len(pose), 0))
    at, _ = sensor_frame(pose)
    np.testing.assert_allclose(over(sensor.observe)(pose, none), at, atol=1e-13)
    by_pose, by_landmark = over(sensor.observe_jacobians)(pose, none)
    lever = at - pose[:, :2]
    np.testing.assert_allclose(by_pose[:, :, :2], np.tile(np.eye(2), (len(pose), 1, 1)), atol=0)
    np.testing.assert_allclose(by_pose[:, :, 2], lever @ [[0, 1], [-1, 0]], atol=1e-13)
    assert by_landmark.shape == (len(pose), 2, 0)
    # Metres, however far.
    np.testing.assert_array_equal(residual_of(sensor, [50, 0], [0, 0]), [50, 0])


# --- inverse depth ------------------------------------------------------------------------------

DEPTHS = np.array([0.0, 1e-9, -1e-9, 1e-4, -1e-4, 0.3, -0.3, 2.0, -2.0])


def inverse_depth_world(seed=5):
    """Poses, and landmarks of every inverse depth of DEPTHS, seen first from elsewhere."""
    rng, pose, _ = draw(seed, 5 * len(DEPTHS))
    origin = pose[:, :2] + rng.normal(size=(len(pose), 2)) * 2
    alpha = rng.uniform(-np.pi, np.pi, (len(pose), 1))
    return pose, np.concatenate([origin, alpha, np.tile(DEPTHS, 5)[:, None]], axis=1)


def line_of_sight(pose, landmark):
    """v of Solà (51) and u = (cos α, sin α)."""
    at, theta = sensor_frame(pose)
    u = np.stack([np.cos(landmark[:, 2]), np.sin(landmark[:, 2])], axis=1)
    return landmark[:, 3:] * (landmark[:, :2] - at) + u, u, at, theta


def test_inverse_depth_at_through_and_beyond_infinity():
    """Its derivatives are held to those of this function by `verify`."""
    sensor = sensors.BearingInverseDepth(VARIANCE, mount=MOUNT)
    pose, landmark = inverse_depth_world()
    v, _, _, theta = line_of_sight(pose, landmark)
    same_angle(over(sensor.observe)(pose, landmark)[:, 0], bearing_of(v, theta))


def test_a_landmark_at_infinity_is_a_direction_and_the_bearing_is_smooth_through_it():
    sensor = sensors.BearingInverseDepth(VARIANCE, mount=MOUNT)
    pose, landmark = inverse_depth_world(6)
    observe = over(sensor.observe)

    def seen(rho):
        return observe(pose, np.concatenate([landmark[:, :3], 0 * landmark[:, 3:] + rho], axis=1))

    same_angle(seen(0.0)[:, 0], landmark[:, 2] - pose[:, 2] - MOUNT[2])
    for rho in (1e-9, -1e-9):
        same_angle(seen(rho), seen(0.0), atol=1e-7)
    slope = wrap(seen(1e-6) - seen(0.0)) + wrap(seen(-1e-6) - seen(0.0))
    np.testing.assert_allclose(slope, 0, atol=1e-9)


def test_inverse_depth_sees_a_point_as_bearing_only_does_and_opposite_beyond_infinity():
    pose, landmark = inverse_depth_world(7)
    landmark = landmark[np.abs(landmark[:, 3]) > 1e-5]
    pose = pose[: len(landmark)]
    u = np.stack([np.cos(landmark[:, 2]), np.sin(landmark[:, 2])], axis=1)
    point = landmark[:, :2] + u / landmark[:, 3:]  # (48), also for ρ < 0
    scaled = over(sensors.BearingInverseDepth(VARIANCE, mount=MOUNT).observe)(pose, landmark)
    direct = over(sensors.BearingOnly(VARIANCE, mount=MOUNT).observe)(pose, point)
    beyond = landmark[:, 3] < 0
    assert beyond.any() and not beyond.all()
    same_angle(scaled[~beyond], direct[~beyond], atol=1e-10)
    same_angle(scaled[beyond], direct[beyond] + np.pi, atol=1e-10)


def test_no_line_of_sight_gives_zero_with_zero_derivatives():
    sensor = sensors.BearingInverseDepth(VARIANCE)
    at = [[3.0, 5.0, 0.7]], [[2.0, 5.0, 0.0, 1.0]]  # v = 0 to the last bit
    for leaf in jax.tree.leaves(all_slopes(sensor)(*at)):
        assert not leaf.any()


def test_inverse_depth_starts_where_the_sensor_is_whatever_the_depth():
    sensor = sensors.BearingInverseDepth(VARIANCE, mount=MOUNT)
    rng, pose, _ = draw(8, 4 * len(DEPTHS))
    z, s = rng.uniform(-np.pi, np.pi, (len(pose), 1)), np.tile(DEPTHS, 4)[:, None]
    at, theta = sensor_frame(pose)
    landmark = over(sensor.invert)(pose, z, s)
    np.testing.assert_allclose(landmark[:, :2], at, atol=1e-13)
    same_angle(landmark[:, 2], theta + z[:, 0])
    assert np.all(np.abs(landmark[:, 2]) <= np.pi)
    np.testing.assert_array_equal(landmark[:, 3:], s)
    same_angle(over(sensor.observe)(pose, landmark), z)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_position_cuts_the_inverse_depth_off_but_not_its_slope(dtype):
    sensor = sensors.BearingInverseDepth(VARIANCE)
    depths = np.array([5.0, 0.1, 1e-3, 2e-6, 1e-6, 5e-7, 0.0, -1e-6, -0.3, -100.0])
    rows = np.tile(np.array([1.5, -2.0, 0.6, 0.0]), (len(depths), 1))
    rows[:, 3] = depths
    cut = np.maximum(depths, 1e-6)[:, None]
    c, s = np.cos(0.6), np.sin(0.6)
    rtol = 1e-12 if dtype == np.float64 else 1e-6
    position = sensor.position
    place, forward, reverse, bend = over(
        lambda row: (
            position(row),
            jax.jacfwd(position)(row),
            jax.jacrev(position)(row),
            jax.hessian(position)(row),
        )
    )(rows.astype(dtype))
    assert place.dtype == dtype
    np.testing.assert_allclose(place, [1.5, -2.0] + np.array([c, s]) / cut, rtol=rtol)
    for slope in (forward, reverse):
        np.testing.assert_array_equal(slope[:, :, :2], np.tile(np.eye(2), (len(depths), 1, 1)))
        np.testing.assert_allclose(slope[:, :, 2], np.array([-s, c]) / cut, rtol=rtol)
        np.testing.assert_allclose(slope[:, :, 3], -np.array([c, s]) / cut**2, rtol=rtol)
    # Where nothing is cut off, the second derivative is that of 1/ρ.
    near = depths > 1e-6
    curve = 2 * np.array([c, s]) / cut[near] ** 3
    np.testing.assert_allclose(bend[near][:, :, 3, 3], curve, rtol=rtol)


def test_embed_remembers_where_it_was_seen_from():
    sensor = sensors.BearingInverseDepth(VARIANCE, mount=MOUNT)
    _, pose, point = draw(9)
    at, _ = sensor_frame(pose)
    point[0] = at[0] + 1e-8  # nearer than anything should be
    landmark = over(sensor.embed)(pose, point)
    distance = np.hypot(*(point - at).T)
    np.testing.assert_allclose(landmark[:, :2], at, atol=1e-13)
    same_angle(landmark[1:, 2], np.arctan2(*(point - at).T[::-1])[1:])
    np.testing.assert_allclose(landmark[1:, 3], 1 / distance[1:], rtol=1e-12)
    assert landmark[0, 3] == 1e6


# --- priors -------------------------------------------------------------------------------------


def test_default_priors():
    free = sensors.RangeOnly(VARIANCE).free
    everywhere = np.linspace(-np.pi, np.pi, 200001)
    np.testing.assert_array_equal(free.mean, [0.0])
    np.testing.assert_allclose(free.cov, [[np.var(everywhere)]], rtol=1e-4)
    np.testing.assert_allclose(free.cov, [[np.pi**2 / 3]], rtol=1e-15)
    free = sensors.BearingOnly(VARIANCE).free
    np.testing.assert_array_equal(free.mean, [10.0])
    np.testing.assert_array_equal(free.cov, [[25.0]])
    for distance in (1, 4.0, np.float32(0.5), jnp.asarray(2.0)):
        free = sensors.BearingInverseDepth(VARIANCE, min_distance=distance).free
        np.testing.assert_allclose(free.mean, [0.5 / float(distance)], rtol=1e-15)
        np.testing.assert_allclose(free.cov, [[1 / (4 * float(distance)) ** 2]], rtol=1e-15)
    np.testing.assert_array_equal(sensors.BearingInverseDepth(VARIANCE).free.mean, [0.5])
    given = sensors.BearingInverseDepth(
        VARIANCE, min_distance=2.0, inverse_distance=([0.1], [[0.3]])
    ).free
    np.testing.assert_array_equal(given.mean, [0.1])
    np.testing.assert_array_equal(given.cov, [[0.3]])


def test_gradients_reach_the_least_distance():
    def prior(distance):
        return sensors.BearingInverseDepth(VARIANCE, min_distance=distance).free

    by_mean, by_cov = jax.jit(jax.jacfwd(prior))(2.0)
    np.testing.assert_allclose(by_mean, [-1 / 8], rtol=1e-14)
    np.testing.assert_allclose(by_cov, [[-1 / 64]], rtol=1e-14)


@pytest.mark.parametrize(
    "distance", [0.0, -1.0, np.nan, np.inf, "far", True, None, 1j, [1.0], 1e-320, 1e200]
)
def test_bad_least_distances_are_refused(distance):
    with pytest.raises(ValueError, match=r"^BearingInverseDepth: "):
        sensors.BearingInverseDepth(VARIANCE, min_distance=distance)


# --- in a filter --------------------------------------------------------------------------------


@pytest.mark.sweep
def test_inverse_depth_in_the_ekf_starts_from_the_prior_and_finds_the_distance():
    """Driving past landmarks 3 to 30 m away; one of five slots stays empty."""
    points = np.array([[3.0, 3.0], [6.0, -4.0], [10.0, 10.0], [4.0, 30.0]])
    sensor = sensors.BearingInverseDepth(np.array([[0.002**2]]), mount=MOUNT, min_distance=2.0)
    start = np.zeros(3)
    scenario = Scenario(
        name="passing",
        motion=motion.Increment(np.diag([1e-3, 1e-4]) ** 2),
        sensor=sensor,
        landmarks=over(sensor.embed)(np.zeros((4, 3)), points),
        controls=np.tile([0.2, 0.0], (60, 1)),
        pose_cov=np.diag([0.01, 0.02, 0.005]) ** 2,
    )
    filter = EkfSlam(scenario.motion, sensor, 5)

    @jax.jit
    def go(key):
        truth, log = simulate(scenario, key)
        out = run(filter, log, start, scenario.pose_cov, key, probe=lambda j: (j.landmarks, j.cov))
        return truth, log, out

    truth, log, trace = jax.device_get(go(jax.random.key(3)))
    landmarks, cov = (table[0] for table in trace.probe)
    at, theta = sensor_frame(np.array([[0.2, 0.0, 0.0]]))
    lever = (at - [0.2, 0.0])[0]
    by_pose = np.zeros((4, 3))
    by_pose[:3] = [[1, 0, -lever[1]], [0, 1, lever[0]], [0, 0, 1]]
    for i, z in enumerate(log.scan.z[0, :, 0]):
        wanted = [*at[0], wrap(theta[0] + z), 1 / 4]
        np.testing.assert_allclose(landmarks[i], wanted, atol=1e-12)
        own = slice(3 + 4 * i, 7 + 4 * i)
        spread = by_pose @ cov[:3, :3] @ by_pose.T + np.diag([0, 0, 0.002**2, (1 / 8) ** 2])
        np.testing.assert_allclose(cov[own, own], spread, atol=1e-12)
    estimate = jax.tree.map(lambda leaf: leaf[-1], trace.estimate)
    np.testing.assert_array_equal(estimate.alive, [True] * 4 + [False])
    error = estimate.points[:4] - points
    whitened = np.linalg.solve(estimate.point_covs[:4], error[:, :, None])[:, :, 0]
    assert np.all((error * whitened).sum(axis=1) < 20)
    assert np.linalg.norm(error, axis=1)[:3].max() < 0.3
    # An empty slot stands nowhere, with the unit variance of padding.
    np.testing.assert_array_equal(estimate.point_covs[4], np.eye(2))
    np.testing.assert_array_equal(estimate.points[4], 0)


# --- Lines as landmarks, against points on them; and what is for points alone says so -------------


NOISE = np.diag([0.02, 0.02]) ** 2
MOVES = motion.Increment(1e-4 * np.eye(2))


def points_of(line, at):
    """Points of a line at distances `at` from its foot."""
    r, alpha = line
    normal = np.array([np.cos(alpha), np.sin(alpha)])
    return r * normal + np.asarray(at)[:, None] * np.array([-normal[1], normal[0]])


@pytest.mark.parametrize("line", [(2.0, 0.4), (-1.5, 3.0), (0.0, -2.0)])
def test_a_measured_line_is_that_of_the_points_in_the_robots_frame(line):
    sensor, pose = sensors.Line(NOISE), np.array([0.7, -1.2, 2.8])
    z = np.asarray(sensor.observe(pose, np.array(line)))
    there = points_of(line, [-3.0, 0.0, 5.0])
    np.testing.assert_allclose(from_frame(pose, points_of(z, [-3, 0, 5])), there, atol=4.0)
    # Those points satisfy n·p = r of the measured line, in the robot's frame.
    local = to_frame(pose, there)
    np.testing.assert_allclose(local @ [np.cos(z[1]), np.sin(z[1])], z[0], atol=1e-12)
    np.testing.assert_allclose(sensor.position(np.array(line)), points_of(line, [0])[0], atol=1e-15)


def test_a_carried_line_goes_through_the_carried_points():
    sensor, line, frame = sensors.Line(NOISE), np.array([1.3, -2.9]), np.array([4.0, -2.0, 1.1])
    r, alpha = np.asarray(sensor.move_landmark(frame, line))
    points = from_frame(frame, points_of(line, [-2.0, 0.0, 2.0]))
    np.testing.assert_allclose(points @ [np.cos(alpha), np.sin(alpha)], r, atol=1e-12)
    # The side is kept: the normal turns with the frame.
    assert abs(np.angle(np.exp(1j * (alpha - line[1] - frame[2])))) < 1e-12


def test_nothing_happens_where_the_robot_passes_the_line_or_the_map_the_origin():
    sensor, pose = sensors.Line(NOISE), jnp.zeros(3)
    near = np.array([[-1e-9, 0.5], [0.0, 0.5], [1e-9, 0.5]])
    z = np.asarray(jax.vmap(sensor.observe, (None, 0))(pose, near))
    np.testing.assert_allclose(z, near, atol=1e-15)
    # Across the seam of the angle.
    gap = sensor.residual(jnp.array([1.0, np.pi - 0.01]), jnp.array([1.0, -np.pi + 0.01]))
    np.testing.assert_allclose(gap, [0, -0.02], atol=1e-15)


def test_both_signs_are_one_set_of_points():
    z = np.array([-1.5, 3.0])
    same = np.asarray(turn_to_positive_distance(z))
    np.testing.assert_allclose(same, [1.5, 3.0 - np.pi], atol=1e-15)
    np.testing.assert_allclose(points_of(same, [0.0]), points_of(z, [0.0]), atol=1e-12)
    np.testing.assert_array_equal(turn_to_positive_distance(same), same)


@refused(
    (lambda s: filters.EkfSlam(MOVES, s, 4, linearize=linearize.FirstEstimate()), "line"),
    (lambda s: filters.EkfSlam(MOVES, s, 4, chart=charts.RightInvariant()), "line"),
    (lambda s: filters.Seif(MOVES, s, 4, active=2, links=2), "line"),
    (lambda s: sensors.Suite(((s, 2), (s, 2))), r"share landmarks \(x, y\)"),
    (lambda s: filters.Merging(filters.EkfSlam(MOVES, s, 4), 0.5), "cannot be merged"),
    (
        lambda s: seen_points(s, Scan(jnp.zeros((1, 2)), jnp.zeros(1, int), jnp.ones(1, bool))),
        "seen_points: sensor: expected one that measures points, got line",
    ),
)
def test_what_is_for_points_refuses_lines(make):
    make(sensors.Line(NOISE))


def test_a_line_may_stand_beside_a_compass():
    both = sensors.Suite(((sensors.Line(NOISE), 2), (sensors.Compass([[1e-4]]), 1)))
    assert not both.of_points
    filters.EkfSlam(MOVES, both, 4)
    assert jaxslam.sensors.RangeBearing(NOISE).of_points
