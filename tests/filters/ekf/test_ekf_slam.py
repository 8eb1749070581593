"""EKF-SLAM's bookkeeping: what becomes of each measurement, likelihoods and their gradients, refusals."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from cases import refused

from jaxslam import motion, run, sensors, simulate, slots
from jaxslam.core.types import Log, Scan, Status
from jaxslam.filters import EkfSlam
from jaxslam.math.stats import sigma_gate
from jaxslam.simulation.scenarios import cloister

Q, R = np.diag([0.05, 0.03]) ** 2, np.diag([0.1, 0.05]) ** 2
MOTION, SENSOR = motion.Increment(Q), sensors.RangeBearing(R)
KEY = jax.random.key(0)
CAPACITY, PLACES = 3, 3
OBSERVE = jax.jit(SENSOR.observe)


def scan_of(*measured):
    """A scan of PLACES places from (tag, range, bearing); the rest is padding with garbage in it."""
    rows = [*measured, *[(7, 1e3, -9.0)] * (PLACES - len(measured))]
    z = np.array([row[1:] for row in rows], float)
    return Scan(z, np.array([r[0] for r in rows], np.int32), np.arange(PLACES) < len(measured))


@functools.cache
def compiled_update(**options):
    def update(joint, scan, noise):
        filter = EkfSlam(MOTION, sensors.RangeBearing(noise), CAPACITY, **options)
        return filter.update(joint, scan, KEY)

    return jax.jit(update)


def updater(noise=1.0, **options):
    """(joint, scan) -> joint, info; compiled once for a set of options."""
    update = compiled_update(**({"correction": "sequential"} | options))
    return lambda joint, scan: jax.device_get(update(joint, scan, noise * R))


def start(pose_cov=None, pose=(0.5, -0.3, 0.4)):
    cov = np.diag([0.1, 0.08, 0.05]) ** 2 if pose_cov is None else pose_cov
    joint = slots.empty(jnp.asarray(pose), jnp.asarray(cov), CAPACITY, 2)
    return jax.device_get(joint)


def with_landmarks(count):
    """A map with tags 0, 1, … seen once each."""
    seen = [(0, 2.0, 0.3), (1, 3.0, -1.0), (2, 1.5, 2.5)][:count]
    joint, info = updater()(start(), scan_of(*seen))
    assert list(info.status[:count]) == [Status.BORN] * count
    return jax.device_get(joint)


def expected_z(joint, slot):
    return np.asarray(OBSERVE(joint.pose, joint.landmarks[slot]))


# --- what becomes of a measurement --------------------------------------------------------------


DROPPED = {  # landmarks in a map with room for three, what is measured, what becomes of it
    "an empty scan": (2, [], []),
    "a full map": (
        3,
        [(40, 2.0, 1.0), (41, 3.0, 1.5)],
        [Status.OVERFLOW, Status.OVERFLOW],
    ),
    "room for one": (2, [(40, 2.0, 1.0), (41, 3.0, 1.5)], [Status.BORN, Status.OVERFLOW]),
    "a new tag twice": (0, [(5, 2.0, 0.3), (5, 9.0, 2.0)], [Status.BORN, Status.REPEATED]),
    "an unknown identity": (1, [(-1, 2.0, 0.3)], [Status.UNMATCHED]),
}


@pytest.mark.parametrize("case", DROPPED)
def test_what_is_dropped_is_told_and_leaves_no_trace(case):
    """The state is as after a scan without it. Quotas of births: tests/equivalence/test_reference.py."""
    count, seen, wanted = DROPPED[case]
    joint = with_landmarks(count) if count else start()
    after, info = updater()(joint, scan_of(*seen))
    assert list(info.status) == wanted + [Status.EMPTY] * (PLACES - len(seen))
    born = [s for s, status in zip(seen, wanted, strict=True) if status == Status.BORN]
    chex.assert_trees_all_equal(updater()(joint, scan_of(*born))[0] if born else joint, after)
    assert list(after.tag[count : count + len(born)]) == [tag for tag, *_ in born]
    assert list(info.slot) == [count] * len(born) + [-1] * (PLACES - len(born))
    overflows = wanted.count(Status.OVERFLOW)
    assert (bool(info.overflow), int(info.tally(Status.OVERFLOW))) == (overflows > 0, overflows)
    assert float(info.log_likelihood) == 0
    assert not info.dof.any()


@pytest.mark.parametrize("update", ["sequential", "joint"])
def test_the_gate_rejects_by_the_mahalanobis_distance_of_the_place_alone(update):
    joint = with_landmarks(3)
    gated = updater(correction=update, gate=sigma_gate(3, 2))
    cov, h = joint.cov, np.zeros((2, 9))
    h[:, :3], h[:, 5:7] = SENSOR.observe_jacobians(
        *map(jnp.asarray, (joint.pose, joint.landmarks[1]))
    )
    s = h @ cov @ h.T + R
    direction = np.linalg.cholesky(s) @ [0.6, 0.8]  # exactly one sigma
    for distance, status in ((2.999, Status.FUSED), (3.001, Status.REJECTED)):
        z = expected_z(joint, 1) + distance * direction
        after, info = gated(joint, scan_of((1, *z)))
        assert int(info.status[0]) == status
        np.testing.assert_allclose(info.nis[0], distance**2, rtol=1e-9)
        np.testing.assert_allclose(info.innovation_cov[0], s, atol=1e-12)
        np.testing.assert_allclose(info.innovation[0], distance * direction, atol=1e-12)
        fused = status == Status.FUSED
        assert int(info.dof[0]) == (2 if fused else 0)
        assert int(info.slot[0]) == (1 if fused else -1)
        if fused:
            logpdf = scipy.stats.multivariate_normal.logpdf(distance * direction, cov=s)
            np.testing.assert_allclose(info.log_likelihood, logpdf, rtol=1e-10)
        else:
            chex.assert_trees_all_equal(joint, after)
            assert float(info.log_likelihood) == 0


def known_exactly(joint):
    """The same map with no uncertainty left in it."""
    return joint._replace(cov=np.zeros_like(joint.cov))


@pytest.mark.parametrize("gate", [None, 0.99])
@pytest.mark.parametrize("update", ["sequential", "joint"])
def test_a_singular_innovation_is_dropped_and_all_stays_finite(update, gate):
    """A perfect sensor in a world known exactly: S = 0."""
    joint = known_exactly(with_landmarks(3))
    z = expected_z(joint, 1) + 0.01
    after, info = updater(noise=0.0, correction=update, gate=gate)(joint, scan_of((1, *z)))
    assert list(info.status) == [Status.SINGULAR, Status.EMPTY, Status.EMPTY]
    chex.assert_trees_all_equal(joint, after)
    chex.assert_tree_all_finite(info)
    assert float(info.log_likelihood) == 0
    assert not info.dof.any()
    assert int(info.slot[0]) == -1


@pytest.mark.parametrize("update", ["sequential", "joint"])
def test_a_half_singular_innovation_is_dropped_whole(update):
    """One perfect coordinate and only the heading uncertain: S = diag(0, σ²) corrects nothing."""
    joint = known_exactly(with_landmarks(3))._replace(pose=np.zeros(3))
    joint.cov[2, 2] = 0.1
    joint = joint._replace(landmarks=np.array([[5.0, 5.0], [2.0, 0.0], [5.0, -5.0]]))
    noise = np.diag([0.0, 0.01])
    after, info = compiled_update(correction=update)(joint, scan_of((1, 2.1, 0.1)), noise)
    assert not info.innovation_cov[0, 0].any()
    assert int(info.status[0]) == Status.SINGULAR
    chex.assert_trees_all_equal(joint, after)
    chex.assert_tree_all_finite(info)


@pytest.mark.parametrize("places", [3, 5])
def test_one_singular_place_does_not_keep_the_others_from_correcting(places):
    """A joint update of a perfectly known and an uncertain landmark, by a perfect sensor.

    Three places are 6 rows, factored by unrolled code; five are 10, factored by LAPACK.
    """
    joint = known_exactly(with_landmarks(3))
    joint.cov[5:7, 5:7] = 0.01 * np.eye(2)
    z = [expected_z(joint, 0), expected_z(joint, 1) + 0.01, *[(9.0, 9.0)] * (places - 2)]
    tag, valid = np.array([0, 1, *[7] * (places - 2)], np.int32), np.arange(places) < 2
    after, info = updater(noise=0.0, correction="joint")(joint, Scan(np.array(z), tag, valid))
    assert list(info.status) == [Status.SINGULAR, Status.FUSED, *[Status.EMPTY] * (places - 2)]
    np.testing.assert_allclose(expected_z(after, 1), z[1], atol=1e-3)
    np.testing.assert_allclose(after.cov[5:7, 5:7], 0, atol=1e-12)


def test_padding_may_hold_nan():
    joint = with_landmarks(2)
    good = scan_of((1, *(expected_z(joint, 1) + 0.01)))
    spoiled = good._replace(z=np.where(good.valid[:, None], good.z, np.nan))
    for update in ("sequential", "joint"):
        expected = updater(correction=update, gate=sigma_gate(3, 2))(joint, good)
        got = updater(correction=update, gate=sigma_gate(3, 2))(joint, spoiled)
        chex.assert_tree_all_finite(got)
        chex.assert_trees_all_equal(expected, got)


def test_a_removed_landmark_leaves_its_slot_to_the_next():
    joint = with_landmarks(3)
    left = slots.remove(joint, np.array([False, True, False]))
    again, info = updater()(left, scan_of((1, 2.5, -0.5)))
    assert int(info.status[0]) == Status.BORN
    assert int(info.slot[0]) == 1
    assert list(again.tag) == [0, 1, 2]
    fresh = np.asarray(again.landmarks[1])
    np.testing.assert_allclose(expected_z(again, 1), [2.5, -0.5], atol=1e-12)
    assert np.abs(fresh - joint.landmarks[1]).max() > 0.1
    keep = np.r_[0:5, 7:9]
    np.testing.assert_array_equal(again.cov[np.ix_(keep, keep)], joint.cov[np.ix_(keep, keep)])


def test_starting_where_the_robot_knows_exactly_where_it_is():
    joint, info = updater()(start(np.zeros((3, 3))), scan_of((0, 2.0, 0.3)))
    assert int(info.status[0]) == Status.BORN
    assert not joint.cov[:3].any()
    turned = np.array([[np.cos(0.7), -2 * np.sin(0.7)], [np.sin(0.7), 2 * np.cos(0.7)]])
    np.testing.assert_allclose(joint.cov[3:5, 3:5], turned @ R @ turned.T, atol=1e-15)
    joint, info = updater()(jax.device_get(joint), scan_of((0, 2.1, 0.32)))
    assert int(info.status[0]) == Status.FUSED
    # Twice the data, half the covariance, to first order in the innovation.
    np.testing.assert_allclose(joint.cov[3:5, 3:5], turned @ R @ turned.T / 2, rtol=0.2, atol=1e-4)
    chex.assert_tree_all_finite((joint, info))


# --- likelihoods --------------------------------------------------------------------------------


def test_joint_nis_and_log_likelihood_are_the_dense_formulas():
    joint = with_landmarks(3)
    seen = [
        (2, *(expected_z(joint, 2) + [0.1, -0.03])),
        (0, *(expected_z(joint, 0) + [-0.2, 0.05])),
    ]
    _, info = updater(correction="joint")(joint, scan_of(*seen))
    h = np.zeros((4, 9))
    for i, slot in enumerate((2, 0)):
        by_pose, by_landmark = SENSOR.observe_jacobians(
            jnp.asarray(joint.pose), jnp.asarray(joint.landmarks[slot])
        )
        h[2 * i : 2 * i + 2, :3] = by_pose
        h[2 * i : 2 * i + 2, 3 + 2 * slot : 5 + 2 * slot] = by_landmark
    s, nu = h @ joint.cov @ h.T + np.kron(np.eye(2), R), np.array([0.1, -0.03, -0.2, 0.05])
    np.testing.assert_allclose(info.nis.sum(), nu @ np.linalg.solve(s, nu), rtol=1e-9)
    first = nu[:2] @ np.linalg.solve(s[:2, :2], nu[:2])
    np.testing.assert_allclose(info.nis[0], first, rtol=1e-9)
    logpdf = scipy.stats.multivariate_normal.logpdf(nu, cov=s)
    np.testing.assert_allclose(info.log_likelihood, logpdf, rtol=1e-9)
    np.testing.assert_array_equal(info.dof, [2, 2, 0])


def test_sequential_log_likelihood_is_that_of_its_innovations():
    joint = with_landmarks(3)
    seen = [
        (2, *(expected_z(joint, 2) + [0.1, -0.03])),
        (0, *(expected_z(joint, 0) + [-0.2, 0.05])),
    ]
    _, info = updater()(joint, scan_of(*seen))
    nu, s = np.asarray(info.innovation), np.asarray(info.innovation_cov)
    total = sum(scipy.stats.multivariate_normal.logpdf(nu[i], cov=s[i]) for i in (0, 1))
    np.testing.assert_allclose(info.log_likelihood, total, rtol=1e-10)
    np.testing.assert_allclose(info.nis[1], nu[1] @ np.linalg.solve(s[1], nu[1]), rtol=1e-10)


PARAMETERS = {
    "forward noise": 0.012,
    "turn noise": 0.018,
    "range noise": 0.11,
    "bearing noise": 0.02,
    "mount x": 0.05,
    "mount y": -0.03,
    "mount turn": 0.02,
    "start x": 0.01,
    "start y": -2.02,
    "start turn": 0.01,
}


@pytest.fixture(scope="module")
def likelihood():
    """(parameters, log) -> log-likelihood of 20 cloister steps plus the last pose, and its gradient."""

    def total(parameters, log):
        p = parameters
        robot = motion.Increment(jnp.diag(p[:2]) ** 2)
        sensor = sensors.RangeBearing(jnp.diag(p[2:4]) ** 2, mount=p[4:7])
        filter = EkfSlam(robot, sensor, 36, births=4, correction="joint")
        trace = run(filter, log, p[7:10], jnp.zeros((3, 3)), KEY)
        return trace.info.log_likelihood.sum() + trace.final.pose.sum()

    return jax.jit(jax.value_and_grad(total))


@pytest.fixture(scope="module")
def cloister_log():
    return jax.device_get(jax.jit(lambda key: simulate(cloister(20), key))(jax.random.key(4)))[1]


def test_gradients_of_the_log_likelihood_are_differences(likelihood, cloister_log):
    at = np.array(list(PARAMETERS.values()))
    _, slope = likelihood(at, cloister_log)
    for i, name in enumerate(PARAMETERS):
        step = 1e-6 * np.eye(len(at))[i]
        ahead, behind = (
            likelihood(at + step, cloister_log)[0],
            likelihood(at - step, cloister_log)[0],
        )
        numeric = (ahead - behind) / 2e-6
        assert abs(slope[i] - numeric) < 1e-5 * (1 + abs(numeric)), name
        assert abs(slope[i]) > 1e-2, name  # every parameter is reached
    # The likelihood does not know where the world has its origin; the last pose moves along.
    np.testing.assert_allclose(slope[7:9], [1, 1], atol=1e-9)


def test_gradients_are_finite_with_a_landmark_exactly_at_the_robot(likelihood, cloister_log):
    """The first landmark is seen at range 0 from a robot that never moves."""
    scan = cloister_log.scan
    only_first = np.arange(36)[None, :] == np.zeros((20, 1))
    still = Log(np.zeros((20, 2)), Scan(np.zeros((20, 36, 2)), scan.tag, only_first))
    at = np.array(list(PARAMETERS.values()))
    at[4:7] = 0
    value, slope = likelihood(at, still)
    assert np.isfinite(value)
    assert np.isfinite(slope).all()
    # H is zero there, so S = R, and 19 of 20 scans say N(0; 0, R); the robot stays at the start.
    expected = -19 * np.log(2 * np.pi * 0.11 * 0.02) + at[7:].sum()
    np.testing.assert_allclose(value, expected, rtol=1e-9)
    np.testing.assert_allclose(slope[2:4], [-19 / 0.11, -19 / 0.02], rtol=1e-9)


# --- refusals -----------------------------------------------------------------------------------


@refused(
    ({"capacity": 0}, "capacity"),
    ({"capacity": 2.5}, "capacity"),
    ({"iterations": 0}, "iterations"),
    ({"iterations": -1}, "iterations"),
    ({"births": 0}, "births"),
    ({"correction": "x"}, "correction"),
    ({"gate": 0.0}, "gate"),
    ({"gate": -1}, "gate"),
    ({"gate": float("nan")}, "gate"),
    told="EkfSlam: .*",
)
def test_bad_options_are_refused(options):
    EkfSlam(MOTION, SENSOR, **({"capacity": 3} | options))


def good_log(steps=3):
    z = np.tile([[2.0, 0.3], [3.0, -1.0], [1.5, 2.5]], (steps, 1, 1))
    tag = np.tile(np.arange(3, dtype=np.int32), (steps, 1))
    return Log(np.full((steps, 2), 0.1), Scan(z, tag, np.ones((steps, 3), bool)))


def spoiled(field, row, value):
    log = jax.tree.map(np.array, good_log())
    (log.control if field == "control" else getattr(log.scan, field))[row] = value
    return log


@pytest.fixture(scope="module")
def good_trace():
    filter = EkfSlam(MOTION, SENSOR, CAPACITY)
    go = jax.jit(lambda log: run(filter, log, np.zeros(3), np.eye(3), KEY, probe=lambda s: s.tag))
    return lambda log: jax.device_get(go(log))


def test_run_predicts_then_updates_and_records_every_step(good_trace):
    log = good_log()
    trace = good_trace(log)
    filter = EkfSlam(MOTION, SENSOR, CAPACITY)
    state = jax.jit(filter.init)(np.zeros(3), np.eye(3))
    predict = jax.jit(lambda s, u: filter.predict(s, u, KEY))
    for t in range(3):
        state, info = updater()(
            predict(state, log.control[t]), jax.tree.map(lambda a: a[t], log.scan)
        )
        np.testing.assert_allclose(trace.estimate.pose[t], state.pose, atol=1e-14)
        np.testing.assert_allclose(trace.estimate.pose_cov[t], state.cov[:3, :3], atol=1e-14)
        np.testing.assert_allclose(trace.info.log_likelihood[t], info.log_likelihood, atol=1e-11)
        np.testing.assert_array_equal(trace.probe[t], state.tag)
    chex.assert_trees_all_close(trace.final, state, atol=1e-14, rtol=1e-7)


def test_a_repeated_tag_that_escapes_the_check_under_jit_is_born_once(good_trace):
    trace = good_trace(spoiled("tag", (slice(None), 1), 0))  # tags 0, 0, 2 in every scan
    assert list(trace.info.status[0]) == [Status.BORN, Status.REPEATED, Status.BORN]
    assert list(trace.info.status[1]) == [Status.FUSED, Status.FUSED, Status.FUSED]
    assert list(trace.final.tag) == [0, 2, -1]


def test_what_is_not_finite_and_escapes_the_check_under_jit_is_dropped(good_trace):
    """Neither a landmark that is known nor one that is new takes NaN in."""
    log = spoiled("z", (1, 1, 0), np.nan)
    log = log._replace(scan=log.scan._replace(z=log.scan.z.copy()))
    log.scan.z[0, 2, 1] = np.inf
    trace = good_trace(log)
    valid = log.scan.valid.copy()
    valid[1, 1] = valid[0, 2] = False
    expected = good_trace(log._replace(scan=log.scan._replace(valid=valid)))
    assert trace.info.status[1, 1] == trace.info.status[0, 2] == Status.REJECTED
    chex.assert_tree_all_finite(trace.estimate)
    chex.assert_trees_all_equal(expected.estimate, trace.estimate)
    np.testing.assert_array_equal(expected.info.log_likelihood, trace.info.log_likelihood)
