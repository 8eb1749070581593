"""Absolute sensors in the EKF: without a landmark it is the plain Kalman filter of the pose alone."""

import functools

import chex
import jax
import numpy as np
import pytest
import scipy.stats
from cases import swept
from reference.plane import turn, wrap

from jaxslam import Scenario, charts, motion, run, sensors, simulate
from jaxslam.core.types import Log, Scan, Status
from jaxslam.filters import DeadReckoning, EkfSlam

KEY = jax.random.key(0)
STEPS, PLACES = 50, 3
OUTLIER = (20, 1)  # the step and place that is spoiled where one is
Q = np.diag([0.05, 0.02]) ** 2
R = {"compass": np.array([[0.05**2]]), "position_fix": np.array([[0.04, 0.01], [0.01, 0.03]])}
MOUNT = np.array([0.4, -0.3, 2.0])
START, SPREAD = np.array([1.0, -2.0, 2.8]), np.diag([0.3, 0.2, 0.1]) ** 2
CONTROLS = np.tile([0.3, 0.15], (STEPS, 1))  # a whole turn and more
CONTROLS[30:40, 1] = 0.03  # slowly where the compass is near its seam


# --- the pose-only EKF, written from the equations ----------------------------------------------


def move(x, u):
    d, turned = u
    c, s = np.cos(x[2]), np.sin(x[2])
    by_pose = np.array([[1, 0, -d * s], [0, 1, d * c], [0, 0, 1]])
    by_noise = np.array([[c, 0], [s, 0], [0, 1]])
    return np.array([x[0] + d * c, x[1] + d * s, wrap(x[2] + turned)]), by_pose, by_noise


def see(name, x, mount):
    if name == "compass":
        return np.array([x[2] + mount[2]]), np.array([[0.0, 0.0, 1.0]])
    lever = turn(x[2]) @ mount[:2]
    return x[:2] + lever, np.array([[1, 0, -lever[1]], [0, 1, lever[0]]])


def innovation(name, z, z_hat):
    return wrap(z - z_hat) if name == "compass" else z - z_hat


def plain_ekf(name, log, mount, joint):
    """Poses (T, 3), covariances (T, 3, 3), log-likelihoods (T,)."""
    x, p, history = START, SPREAD, []
    for u, z, valid in zip(log.control, log.scan.z, log.scan.valid, strict=True):
        x, by_pose, by_noise = move(x, u)
        p = by_pose @ p @ by_pose.T + by_noise @ Q @ by_noise.T
        total, there = 0.0, z[valid]
        batches = [there] if joint else [row[None] for row in there]
        for batch in batches:
            if len(batch) == 0:
                continue
            z_hat, h = see(name, x, mount)
            nu = innovation(name, batch, z_hat[None]).ravel()
            h = np.tile(h, (len(batch), 1))
            s = h @ p @ h.T + np.kron(np.eye(len(batch)), R[name])
            gain = p @ h.T @ np.linalg.inv(s)
            total += scipy.stats.multivariate_normal.logpdf(nu, cov=s)
            x = x + gain @ nu
            x[2] = wrap(x[2])
            p = (np.eye(3) - gain @ h) @ p
        history.append((x, p, total))
    return [np.array(column) for column in zip(*history, strict=True)]


def drive(name, mount, seed=1):
    """A log drawn in NumPy: one to three measurements a scan, now and then none, tags of any kind."""
    rng = np.random.default_rng(seed)
    x, rows = rng.multivariate_normal(START, SPREAD), []
    for u in CONTROLS:
        x, _, _ = move(x, u + rng.multivariate_normal(np.zeros(2), Q))
        exact = see(name, x, mount)[0]
        noise = rng.multivariate_normal(np.zeros(len(exact)), R[name], PLACES)
        rows.append(innovation(name, exact + noise, 0.0))
    valid = rng.random((STEPS, PLACES)) < 0.6
    valid[OUTLIER[0]] = [True, True, False]
    tag = np.where(rng.random((STEPS, PLACES)) < 0.5, -1, np.arange(PLACES) + 7).astype(np.int32)
    z = np.where(valid[:, :, None], np.array(rows), 1e3)  # garbage in the padding
    return Log(CONTROLS, Scan(z, tag, valid))


@functools.cache
def compiled(name, **options):
    def go(log, mount, gate, pose_cov, q, r):
        sensor = sensors.REGISTRY[name](r * R[name], mount=mount)
        filter = EkfSlam(motion.Increment(q * Q), sensor, 2, gate=gate, **options)
        return run(filter, log, START, pose_cov, KEY, probe=lambda joint: joint.cov)

    return jax.jit(go)


def filtered(name, log, mount=MOUNT, gate=1.0, pose_cov=SPREAD, q=1.0, r=1.0, **options):
    go = compiled(name, **({"correction": "sequential"} | options))
    return jax.device_get(go(log, np.asarray(mount), float(gate), pose_cov, q, r))


def assert_same(a, b):
    np.testing.assert_allclose(wrap(a.estimate.pose[:, 2] - b.estimate.pose[:, 2]), 0, atol=1e-9)
    np.testing.assert_allclose(a.estimate.pose[:, :2], b.estimate.pose[:, :2], atol=1e-9)
    np.testing.assert_allclose(a.estimate.pose_cov, b.estimate.pose_cov, atol=1e-9)


@pytest.mark.parametrize("update", swept(["sequential", "joint"], "joint"))
@pytest.mark.parametrize("name", R)
def test_the_ekf_is_the_plain_one_of_the_pose(name, update):
    log = drive(name, MOUNT)
    trace = filtered(name, log, correction=update)
    poses, covs, likelihoods = plain_ekf(name, log, MOUNT, joint=update == "joint")
    gap = trace.estimate.pose - poses
    np.testing.assert_allclose(gap[:, :2], 0, atol=1e-9)
    np.testing.assert_allclose(wrap(gap[:, 2]), 0, atol=1e-9)
    np.testing.assert_allclose(trace.estimate.pose_cov, covs, atol=1e-9)
    np.testing.assert_allclose(trace.info.log_likelihood, likelihoods, atol=1e-9)
    assert np.ptp(wrap(poses[:, 2])) > 6  # it went around
    if name == "compass":  # the seam lay between some measurements and their predictions
        apart = np.abs(log.scan.z[:, :, 0] - wrap(poses[:, 2:] + MOUNT[2]))
        assert (apart[log.scan.valid] > np.pi).any()
    # Each valid measurement corrects, whatever its tag; there is no landmark and never will be.
    there = log.scan.valid
    np.testing.assert_array_equal(
        trace.info.status, np.where(there, Status.FUSED, Status.EMPTY).astype(np.int32)
    )
    np.testing.assert_array_equal(trace.info.dof, np.where(there, len(R[name]), 0))
    assert (trace.info.slot == -1).all()
    assert trace.probe.shape == (STEPS, 3, 3)
    assert not trace.estimate.alive.any()
    assert (trace.estimate.tag == -1).all()
    assert trace.estimate.points.shape == (STEPS, 2, 2) and not trace.estimate.points.any()
    assert np.isfinite(trace.estimate.point_covs).all()


@pytest.mark.sweep
@pytest.mark.parametrize("name", R)
def test_joint_is_sequential_where_the_measurement_is_linear(name):
    """Without a lever arm a position fix is linear in the pose, as a compass always is."""
    log = drive(name, np.zeros(3))
    assert (log.scan.valid.sum(axis=1) > 1).any()
    one_by_one = filtered(name, log, mount=np.zeros(3))
    together = filtered(name, log, mount=np.zeros(3), correction="joint")
    assert_same(one_by_one, together)
    total = one_by_one.info.log_likelihood
    np.testing.assert_allclose(total, together.info.log_likelihood, atol=1e-9)


@pytest.mark.sweep
def test_iterations_and_josephs_form_change_nothing_where_the_measurement_is_linear():
    log = drive("position_fix", np.zeros(3))
    once = filtered("position_fix", log, mount=np.zeros(3))
    again = filtered("position_fix", log, mount=np.zeros(3), iterations=2, covariance="joseph")
    assert_same(once, again)


@pytest.mark.parametrize("name", R)
def test_the_gate_rejects_and_counts_an_outlier(name):
    log = drive(name, MOUNT)
    spoiled = jax.tree.map(np.copy, log)
    spoiled.scan.z[OUTLIER] += 1.5  # rad or m: far outside
    gate = 1 - 1e-9
    out = filtered(name, spoiled, gate=gate)
    assert out.info.status[OUTLIER] == Status.REJECTED
    assert out.info.tally(Status.REJECTED).sum() == 1
    assert out.info.nis[OUTLIER] > scipy.stats.chi2.ppf(gate, len(R[name]))
    assert out.info.dof[OUTLIER] == 0 and out.info.slot[OUTLIER] == -1
    log.scan.valid[OUTLIER] = False
    without = filtered(name, log, gate=gate)
    assert_same(out, without)
    np.testing.assert_allclose(out.info.log_likelihood, without.info.log_likelihood, atol=1e-9)


@pytest.mark.parametrize("name", R)
def test_a_perfect_sensor_of_a_pose_known_exactly_is_singular_and_changes_nothing(name):
    log = drive(name, MOUNT)
    trace = filtered(name, log, pose_cov=np.zeros((3, 3)), q=0.0, r=0.0)
    there = np.where(log.scan.valid, Status.SINGULAR, Status.EMPTY)
    np.testing.assert_array_equal(trace.info.status, there.astype(np.int32))
    assert (trace.info.slot == -1).all()
    assert not trace.estimate.pose_cov.any()
    chex.assert_tree_all_finite((trace.estimate, trace.info))


# --- simulated ----------------------------------------------------------------------------------

RUNS = 200


def world(name):
    return Scenario(
        name="absolute",
        motion=motion.Increment(Q),
        sensor=sensors.REGISTRY[name](R[name], mount=MOUNT),
        landmarks=np.zeros((1, 0)),
        controls=CONTROLS,
        pose=START,
    )


def padded(log):
    """The same log with PLACES places a scan."""
    more = ((0, 0), (0, PLACES - 1))
    scan = Scan(
        np.pad(log.scan.z, (*more, (0, 0))),
        np.pad(log.scan.tag, more, constant_values=-1),
        np.pad(log.scan.valid, more),
    )
    return log._replace(scan=scan)


@pytest.mark.sweep
@pytest.mark.parametrize("name", R)
def test_simulated_runs_have_an_honest_nees(name):
    keys = jax.random.split(jax.random.key(5), RUNS)
    truth, log = jax.device_get(jax.jit(jax.vmap(functools.partial(simulate, world(name))))(keys))

    def nees(r):
        total = np.zeros(3)
        for i in range(RUNS):  # one by one, in the function that is compiled already
            one = padded(jax.tree.map(lambda leaf: leaf[i], log))
            estimate = filtered(name, one, pose_cov=np.zeros((3, 3)), r=r).estimate
            for k, t in enumerate((9, 24, 49)):
                error = truth.pose[i, t] - estimate.pose[t]
                error[2] = wrap(error[2])
                total[k] += error @ np.linalg.solve(estimate.pose_cov[t], error)
        return total

    honest = nees(1.0)
    low, high = scipy.stats.chi2.ppf([5e-4, 1 - 5e-4], 3 * RUNS)
    assert np.all((low < honest) & (honest < high))
    assert nees(1 / 16)[-1] > high  # and a claim of a four times better sensor is found out

    # What the simulator wrote: one measurement a scan, with the sensor's noise.
    size = len(R[name])
    assert truth.landmarks.shape == (RUNS, 1, 0) and not truth.missed.any()
    assert log.scan.z.shape == (RUNS, STEPS, 1, size) and log.scan.valid.all()
    exact = np.array([see(name, x, MOUNT)[0] for x in truth.pose.reshape(-1, 3)])
    noise = innovation(name, log.scan.z.reshape(-1, size), exact)
    np.testing.assert_allclose(np.atleast_2d(np.cov(noise.T)), R[name], rtol=0.1, atol=1e-3)
    np.testing.assert_allclose(noise.mean(axis=0), 0, atol=4 * np.sqrt(R[name].max() / len(noise)))


# --- what is taken and what is refused ----------------------------------------------------------


def test_unknown_tags_may_repeat_within_a_scan():
    scan = Scan(np.zeros((2, 3, 1)), np.full((2, 3), -1, np.int32), np.ones((2, 3), bool))
    log = Log(np.zeros((2, 2)), scan)
    reckoning = DeadReckoning(motion.Increment(Q), sensors.Compass(R["compass"]))
    jax.eval_shape(lambda key: run(reckoning, log, START, SPREAD, key), KEY)  # is accepted


@pytest.mark.parametrize("name", R)
def test_a_chart_of_landmarks_and_an_empty_capacity_are_refused(name):
    sensor = sensors.REGISTRY[name](R[name])
    with pytest.raises(ValueError, match=f"right_invariant.*absolute sensor {name} has none"):
        EkfSlam(motion.Increment(Q), sensor, 1, chart=charts.RightInvariant())
    with pytest.raises(ValueError, match="EkfSlam: capacity"):
        EkfSlam(motion.Increment(Q), sensor, 0)
