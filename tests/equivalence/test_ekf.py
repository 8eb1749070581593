"""What EKF-SLAM must equal: dense textbook updates in any chart, itself in other words, its limits."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import swept
from own_models import changed
from worlds import narrow

from jaxslam import Scenario, charts, linearize, motion, run, sensors, simulate
from jaxslam.core.slots import Joint
from jaxslam.core.types import Scan, Status
from jaxslam.filters import EkfSlam

Q, R = np.diag([0.05, 0.03]) ** 2, np.array([[0.01, 0.001], [0.001, 0.0025]])
MOUNT = (0.2, -0.1, 0.4)
MOTION, SENSOR = motion.Increment(Q), sensors.RangeBearing(R, mount=MOUNT)
OBSERVE, INVERT, STEP = jax.jit(SENSOR.observe), jax.jit(SENSOR.invert), jax.jit(MOTION.step)
OBSERVE_JACOBIANS = jax.jit(SENSOR.observe_jacobians)
ROWS = 32
KEY = jax.random.key(0)
CAPACITY = 4


def some_joint(alive=(True, True, False, True), seed=0, size=0.1):
    """A map in mid-flight with arbitrary correlations; tags 10 + slot."""
    rng = np.random.default_rng(seed)
    alive = np.array(alive)
    dead = np.concatenate([np.zeros(3, bool), np.repeat(~alive, 2)])
    root = rng.normal(size=(len(dead), len(dead))) * size
    cov = np.where(dead[:, None] | dead[None, :], np.eye(len(dead)), root @ root.T)
    return Joint(
        pose=np.array([1.0, -0.5, 3.0]),
        landmarks=np.where(alive[:, None], rng.normal(size=(len(alive), 2)) * 4, 0.0),
        cov=cov,
        alive=alive,
        tag=np.where(alive, 10 + np.arange(len(alive)), -1).astype(np.int32),
        lin=(),
    )


def some_scan(joint, tags, seed=1, noise=0.1):
    """Measurements of the landmarks with these tags, off by about the noise."""
    rng = np.random.default_rng(seed)
    z = np.array([OBSERVE(joint.pose, joint.landmarks[tag - 10]) for tag in tags])
    z = z + rng.normal(size=(len(tags), 2)) * noise
    return Scan(z, np.array(tags, np.int32), np.ones(len(tags), bool))


assert_same = functools.partial(chex.assert_trees_all_close, rtol=0)


@functools.cache
def updater(**options):
    """A compiled update of `EkfSlam` with these options; "chart" by name."""
    options = dict(options)
    chart = charts.REGISTRY[options.pop("chart", "euclidean")]()
    filter = EkfSlam(MOTION, SENSOR, CAPACITY, chart=chart, **options)
    update = jax.jit(lambda joint, scan: filter.update(joint, scan, KEY))
    return lambda joint, scan: jax.device_get(update(joint, scan))


@functools.cache
def estimator(name):
    return jax.jit(EkfSlam(MOTION, SENSOR, CAPACITY, chart=charts.REGISTRY[name]()).estimate)


# --- dense oracle: numeric Jacobians in chart coordinates, textbook products ---------------------


def over_rows(function):
    """The function over up to ROWS rows of all its arguments, as one program for any number."""
    batched = jax.jit(jax.vmap(function))

    def mapped(*arguments):
        wide = [np.pad(a, [(0, ROWS - len(a))] + [(0, 0)] * (a.ndim - 1)) for a in arguments]
        return jax.tree.map(lambda out: np.asarray(out)[: len(arguments[0])], batched(*wide))

    return mapped


def of_map(function):
    """A chart's function of a pose and one landmark, over all the landmarks of a map."""
    whole = jax.vmap(function, in_axes=(None, 0, None, 0))
    return over_rows(lambda *arguments: whole(*arguments))


CHARTS = list(charts.REGISTRY)
RETRACT = {name: of_map(charts.REGISTRY[name]().retract) for name in CHARTS}
LOCAL = {name: of_map(charts.REGISTRY[name]().local) for name in CHARTS}
SEEN = over_rows(jax.vmap(SENSOR.observe, (None, 0)))
FOUND = over_rows(jax.vmap(lambda pose, z: SENSOR.invert(pose, z, jnp.zeros(0)), (None, 0)))


def each(value, like):
    """The same value in as many rows."""
    return np.broadcast_to(value, (len(like), *np.shape(value)))


class Dense:
    """Functions of rows of error vectors ξ (C, D) of a chart about a joint, and their Jacobians."""

    def __init__(self, joint, name):
        self.name, self.joint, self.size = name, joint, joint.cov.shape[0]
        self.p = np.asarray(joint.cov)

    def retract(self, xi):
        """Poses (C, 3), landmarks (C, N, 2)."""
        dl = xi[:, 3:].reshape(len(xi), -1, 2)
        pose, landmarks = each(self.joint.pose, xi), each(self.joint.landmarks, xi)
        poses, landmarks = RETRACT[self.name](pose, landmarks, xi[:, :3], dl)
        landmarks = np.where(self.joint.alive[:, None], landmarks, dl)  # padding stays put
        return poses[:, 0], landmarks

    def local(self, pose, landmarks, poses, to):
        """Errors (C, 3), (C, N, 2) of poses and landmarks about one of each."""
        dx, dl = LOCAL[self.name](each(pose, poses), each(landmarks, poses), poses, to)
        return dx[:, 0], dl

    def jacobian(self, function, at=None, step=1e-5):
        """Central differences of rows ξ -> rows, angles that cross their seam put right."""
        at = np.zeros(self.size) if at is None else at
        moves = step * np.eye(len(at))
        values = function(np.concatenate([at + moves, at - moves]))
        rise = values[: len(at)] - values[len(at) :]
        rise = rise - 2 * np.pi * np.round(rise / (2 * np.pi))
        return rise.T / (2 * step)

    def observe(self, slots_seen):
        def function(xi):
            pose, landmarks = self.retract(xi)
            # Two always, so that one program serves all.
            seen = SEEN(pose, landmarks[:, np.resize(slots_seen, 2)])
            return seen[:, : len(slots_seen)].reshape(len(xi), -1)

        return function

    def update(self, scan, slots_seen, iterations):
        """(I - KH) P and K ν with the H of the newest estimate, always from the prior."""
        observe, xi = self.observe(np.array(slots_seen)), np.zeros(self.size)
        noise = np.kron(np.eye(len(slots_seen)), R)
        for i in range(iterations):
            h = self.jacobian(observe, xi)
            nu = scan.z.ravel() - observe(xi[None])[0]
            nu[1::2] = np.arctan2(np.sin(nu[1::2]), np.cos(nu[1::2]))
            s = h @ self.p @ h.T + noise
            gain = self.p @ h.T @ np.linalg.inv(s)
            if i == 0:
                first = nu, s
            xi = gain @ (nu + h @ xi)
        (pose,), (landmarks,) = self.retract(xi[None])
        return (pose, landmarks), (np.eye(self.size) - gain @ h) @ self.p, *first


def sloping():
    """A robot on a slope that turns it, the more the further it is up: no symmetry to hide behind."""

    def step(pose, u, w):
        moved = MOTION.step(pose, u, w)
        return moved.at[2].add(0.2 * jnp.sin(pose[0]) + 0.1 * pose[1] * w[0])

    return changed(MOTION, step=step)


SLOPING = sloping()
STEP_OF_ROWS = over_rows(SLOPING.step)


@pytest.mark.parametrize("name", swept(CHARTS, "right_invariant"))
def test_prediction_is_a_p_at_plus_b_q_bt(name):
    joint, u = some_joint(), np.array([0.3, 0.4])
    dense = Dense(joint, name)
    ahead = STEP_OF_ROWS(joint.pose[None], u[None], np.zeros((1, 2)))[0]

    def error_after(both):
        pose, landmarks = dense.retract(both[:, : dense.size])
        moved = STEP_OF_ROWS(pose, each(u, both), both[:, dense.size :])
        dx, dl = dense.local(ahead, joint.landmarks, moved, landmarks)
        dl = np.where(joint.alive[:, None], dl, landmarks)
        return np.concatenate([dx, dl.reshape(len(dl), -1)], axis=1)

    both = dense.jacobian(error_after, np.zeros(dense.size + 2))
    a, b = both[:, : dense.size], both[:, dense.size :]
    filter = EkfSlam(SLOPING, SENSOR, CAPACITY, chart=charts.REGISTRY[name]())
    out = jax.device_get(jax.jit(filter.predict)(joint, u, KEY))
    np.testing.assert_allclose(out.cov, a @ dense.p @ a.T + b @ Q @ b.T, rtol=0, atol=1e-8)
    np.testing.assert_array_equal(out.cov, out.cov.T)
    np.testing.assert_allclose(out.pose, ahead, atol=1e-15)
    assert_same(joint[1:2] + joint[3:6], out[1:2] + out[3:6], atol=0)


PASSES = {"correction": "joint", "iterations": 2}


@pytest.mark.parametrize("name", swept(CHARTS, "right_invariant"))
def test_joint_correction_is_the_textbook_update_in_chart_coordinates(name):
    """Two passes: the innovations reported are those of the first."""
    joint = some_joint()
    scan = some_scan(joint, [13, 10])
    (pose, landmarks), p, nu, s = Dense(joint, name).update(scan, [3, 0], PASSES["iterations"])
    out, info = updater(chart=name, **PASSES)(joint, scan)
    np.testing.assert_allclose(out.pose, pose, atol=1e-8)
    np.testing.assert_allclose(out.landmarks, landmarks, atol=1e-8)
    np.testing.assert_allclose(out.cov, p, rtol=0, atol=1e-8)
    np.testing.assert_array_equal(info.status, [Status.FUSED] * 2)
    np.testing.assert_array_equal(info.slot, [3, 0])
    np.testing.assert_allclose(info.innovation.ravel(), nu, atol=1e-12)
    np.testing.assert_allclose(info.innovation_cov[0], s[:2, :2], atol=1e-8)
    np.testing.assert_allclose(info.innovation_cov[1], s[2:, 2:], atol=1e-8)


@pytest.mark.parametrize("name", swept(CHARTS, "right_invariant"))
def test_augmentation_and_estimate_are_first_order_propagation(name):
    joint = some_joint((True, False, False, True))
    dense = Dense(joint, name)
    z = np.array([[2.0, 0.5], [3.0, -2.0]])
    born = FOUND(joint.pose[None], z[None])[0]

    def errors_born(both):
        pose, _ = dense.retract(both[:, : dense.size])
        landmarks = FOUND(pose, z + both[:, dense.size :].reshape(-1, 2, 2))
        # Twice, so that the program of a whole map serves.
        dl = dense.local(joint.pose, np.tile(born, (2, 1)), pose, np.tile(landmarks, (1, 2, 1)))[1]
        return dl[:, :2].reshape(len(dl), -1)

    both = dense.jacobian(errors_born, np.zeros(dense.size + 4))
    by_xi, by_v = both[:, : dense.size], both[:, dense.size :]
    expected = dense.p.copy()
    new, old = slice(5, 9), np.r_[0:5, 9:11]
    expected[new] = by_xi @ dense.p
    expected[:, new] = expected[new].T
    expected[new, new] = by_xi @ dense.p @ by_xi.T + by_v @ np.kron(np.eye(2), R) @ by_v.T

    scan = Scan(z, np.array([50, 51], np.int32), np.ones(2, bool))
    out, info = updater(chart=name, **PASSES)(joint, scan)
    np.testing.assert_array_equal(info.status, [Status.BORN] * 2)
    np.testing.assert_array_equal(out.tag, [10, 50, 51, 13])
    np.testing.assert_allclose(out.landmarks[1:3], born, atol=1e-14)
    np.testing.assert_allclose(out.cov, expected, rtol=0, atol=1e-8)
    np.testing.assert_array_equal(out.cov[np.ix_(old, old)], joint.cov[np.ix_(old, old)])

    # The moments in map coordinates, of the map with the new landmarks in it.
    after = Dense(out, name)

    def coordinates(xi):
        pose, landmarks = after.retract(xi)
        return np.concatenate([pose, landmarks.reshape(len(xi), -1)], axis=1)

    j = after.jacobian(coordinates)
    moments = j @ after.p @ j.T
    estimate = jax.device_get(estimator(name)(out))
    np.testing.assert_allclose(estimate.pose_cov, moments[:3, :3], atol=1e-7)
    for i in range(CAPACITY):
        own = moments[3 + 2 * i : 5 + 2 * i, 3 + 2 * i : 5 + 2 * i]
        np.testing.assert_allclose(estimate.point_covs[i], own, atol=1e-7)
    np.testing.assert_array_equal(estimate.points, out.landmarks)


@pytest.mark.parametrize("name", swept(CHARTS, "right_invariant"))
def test_initial_covariance_is_given_in_map_coordinates(name):
    root = np.random.default_rng(5).normal(size=(3, 3))
    filter = EkfSlam(MOTION, SENSOR, CAPACITY, chart=charts.REGISTRY[name]())
    start = jax.jit(filter.init)(np.array([5.0, -3.0, 2.0]), root @ root.T)
    estimate = estimator(name)(start)
    np.testing.assert_allclose(estimate.pose_cov, root @ root.T, atol=1e-11)
    assert not estimate.alive.any()


@pytest.mark.sweep
def test_iterated_correction_finds_the_most_probable_state_and_counts_the_data_once():
    """Its fixed point is the minimum of ξᵀP⁻¹ξ + νᵀR⁻¹ν, its covariance that of one measurement."""
    joint = some_joint(size=0.25)
    scan = some_scan(joint, [10, 11], noise=0.3)._replace(valid=np.array([True, False]))
    dense = Dense(joint, "euclidean")
    information = np.linalg.inv(dense.p)

    def slope(state):
        xi = np.concatenate([state.pose - joint.pose, (state.landmarks - joint.landmarks).ravel()])
        observe = dense.observe(np.array([0]))
        h = dense.jacobian(observe, xi)
        nu = scan.z[0] - observe(xi[None])[0]
        nu[1] = np.arctan2(np.sin(nu[1]), np.cos(nu[1]))
        curvature = information + h.T @ np.linalg.inv(R) @ h
        # In units of standard deviations.
        return np.linalg.solve(
            curvature, information @ xi - h.T @ np.linalg.solve(R, nu)
        ), curvature

    once, _ = updater()(joint, scan)
    many, _ = updater(iterations=6)(joint, scan)
    (step_once, _), (step_many, curvature) = slope(once), slope(many)
    assert np.abs(step_once).max() > 1e-3
    assert np.abs(step_many).max() < 1e-6
    np.testing.assert_allclose(many.cov, np.linalg.inv(curvature), atol=1e-5)


# --- the same filter in other words -------------------------------------------------------------


def test_sequential_correction_is_joint_correction_one_landmark_at_a_time():
    joint = some_joint()
    scan = some_scan(joint, [13, 10])
    at_once, _ = updater()(joint, scan)
    one_by_one = joint
    for i in range(2):
        alone = scan._replace(valid=np.arange(2) == i)
        one_by_one, _ = updater(correction="joint")(one_by_one, alone)
    assert_same(at_once, one_by_one, atol=1e-13)
    together, _ = updater(correction="joint")(joint, scan)
    assert np.abs(together.pose - at_once.pose).max() > 1e-5  # not on a nonlinear model


def test_joseph_form_is_the_plain_form():
    joint = some_joint()
    scan = some_scan(joint, [13, 11])
    plain, plain_info = updater(correction="joint")(joint, scan)
    joseph, info = updater(correction="joint", covariance="joseph")(joint, scan)
    assert_same((joseph, info), (plain, plain_info), atol=1e-12)
    assert np.abs(plain.cov - joint.cov).max() > 1e-3


def tiny(steps=12):
    """Five landmarks around a short drive, not all of them in view."""
    landmarks = [[2.0, 1.0], [1.0, -2.0], [-1.5, 1.5], [3.0, -1.0], [0.5, 2.5]]
    return Scenario(
        name="tiny",
        motion=MOTION,
        sensor=SENSOR,
        landmarks=landmarks,
        controls=np.tile([0.1, 0.2], (steps, 1)),
        pose_cov=np.diag([0.1, 0.1, 0.05]) ** 2,
        visible=lambda pose, landmark: jnp.sum((landmark - pose[:2]) ** 2) < 8.0,
    )


@pytest.fixture(scope="module")
def logs():
    scenario = tiny()
    keys = jax.random.split(jax.random.key(7), 3)
    return jax.device_get(jax.jit(jax.vmap(lambda key: simulate(scenario, key)))(keys))


def runner(capacity, **options):
    """A whole-log run of the tiny world's filter, to compile or map."""
    scenario = tiny()
    filter = EkfSlam(scenario.motion, scenario.sensor, capacity, **options)

    def go(log):
        return run(filter, log, scenario.pose, scenario.pose_cov, KEY, probe=lambda s: s)

    return go


def take(tree, i):
    return jax.tree.map(lambda a: a[i], tree)


@pytest.fixture(scope="module")
def single():
    """The run of one log, compiled; a second trace is an error."""
    compiled = jax.jit(chex.assert_max_traces(runner(8), n=1))
    return lambda log: jax.device_get(compiled(log))


@pytest.mark.sweep
def test_vmap_is_a_loop_and_one_trace_serves_all_logs(logs, single):
    mapped = jax.device_get(jax.jit(jax.vmap(runner(8)))(logs[1]))
    for i in range(3):
        assert_same(take(mapped, i), single(take(logs[1], i)), atol=1e-11)


@pytest.mark.sweep
def test_capacity_8_is_a_larger_one(logs, single):
    capacity = 70  # P is passed over in another way beyond 128 rows
    roomy = jax.device_get(jax.jit(runner(capacity))(take(logs[1], 0)))
    tight = single(take(logs[1], 0))
    assert tight.estimate.alive[-1].sum() >= 4
    cut = [part[:, :8] for part in roomy.estimate[2:]]
    assert_same([*roomy.estimate[:2], *cut], list(tight.estimate), atol=1e-12)
    assert_same(roomy.info, tight.info, atol=1e-11)
    assert_same(roomy.probe.cov[:, :19, :19], tight.probe.cov, atol=1e-12)
    np.testing.assert_array_equal(roomy.final.cov[19:], np.eye(3 + 2 * capacity)[19:])


# --- linearization at the truth -----------------------------------------------------------------


def test_jacobians_at_the_truth_make_the_covariance_independent_of_the_data(logs, single):
    """With all Jacobians at the truth, P obeys a recursion without measurements in it."""
    truths, drawn = logs
    scenario, start = tiny(), np.zeros(3)

    @jax.jit
    def ideal(truth, log):
        filter = EkfSlam(MOTION, SENSOR, 8, linearize=linearize.AtTruth(truth))
        return run(filter, log, scenario.pose, scenario.pose_cov, KEY, probe=lambda s: s.cov)

    truth, log = take(truths, 0), take(drawn, 0)
    noisy = np.random.default_rng(3).normal(size=log.scan.z.shape) * 0.02
    other = log._replace(scan=log.scan._replace(z=log.scan.z + noisy))
    a, b = ideal(truth, log), ideal(truth, other)
    np.testing.assert_allclose(a.probe, b.probe, rtol=0, atol=1e-14)
    assert np.abs(a.estimate.pose - b.estimate.pose).max() > 1e-3

    # Of a filter whose estimate is the truth, they are the ordinary ones.
    nominal, pose = [], start
    for u in np.asarray(scenario.controls):
        pose = np.asarray(STEP(pose, u, np.zeros(2)))
        nominal.append(pose)
    exact = truth._replace(pose=np.array(nominal), start=start)
    observe = jax.jit(jax.vmap(jax.vmap(SENSOR.observe, (None, 0))))
    z = np.asarray(observe(exact.pose, exact.landmarks[log.scan.tag]))
    faultless = log._replace(scan=log.scan._replace(z=z))
    usual = single(faultless)
    np.testing.assert_allclose(ideal(exact, faultless).probe, usual.probe.cov, rtol=0, atol=1e-12)
    np.testing.assert_allclose(usual.estimate.pose, exact.pose, atol=1e-12)


# --- limits -------------------------------------------------------------------------------------


def rows_of(joint, z):
    """Dense H (2, D) of slot 2, the landmark's Jacobians and mean, for the limit of a large prior."""
    pose = np.asarray(joint.pose)
    landmark = np.asarray(INVERT(joint.pose, z, np.zeros(0)))
    by_pose, by_landmark = OBSERVE_JACOBIANS(pose, landmark)
    h = np.zeros((2, joint.cov.shape[0]))
    h[:, :3], h[:, 7:9] = by_pose, by_landmark
    return h, landmark


def large_prior_update(joint, z, c, dtype):
    """Tacher's other way: a landmark known to within √C, then an ordinary correction."""
    h, _ = rows_of(joint, z)
    p = np.array(joint.cov, dtype)
    p[7:9, 7:9] = c * np.eye(2, dtype=dtype)
    h, r = h.astype(dtype), R.astype(dtype)
    s = h @ p @ h.T + r
    return p - p @ h.T @ np.linalg.inv(s) @ h @ p


def test_augmentation_is_the_limit_of_the_large_prior_which_fails_in_float32():
    """Errata, Tacher 3. In float32 C = 1e6 is wrong by eps·C, 14 % of the landmark's covariance here."""
    joint, z = some_joint(), np.array([3.0, -1.0])
    scan = Scan(np.stack([z, z]), np.array([77, -1], np.int32), np.array([True, False]))
    out, _ = updater()(joint, scan)
    np.testing.assert_allclose(out.landmarks[2], rows_of(joint, z)[1], atol=1e-14)
    # The error of the large prior falls with 1/C, until rounding, eps·C, catches up.
    errors = [np.abs(large_prior_update(joint, z, c, float) - out.cov).max() for c in (1e2, 1e4)]
    assert errors[0] > 50 * errors[1]
    np.testing.assert_allclose(large_prior_update(joint, z, 1e7, float), out.cov, atol=1e-6)
    exact = out.cov[7:9, 7:9]
    direct, _ = updater()(*narrow((joint, scan)))
    assert direct.cov.dtype == np.float32
    np.testing.assert_allclose(direct.cov[7:9, 7:9], exact, rtol=1e-5, atol=1e-6)
    assert np.linalg.eigvalsh(np.asarray(direct.cov, float))[0] > 0
    bad = large_prior_update(joint, z, np.float32(1e6), np.float32)
    relative = np.abs(bad[7:9, 7:9] - exact).max() / np.abs(exact).max()
    assert relative > 0.1 or np.linalg.eigvalsh(bad.astype(float))[0] < 0
