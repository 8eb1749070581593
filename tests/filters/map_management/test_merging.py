"""Merging two landmarks that are one: the joint test, the constraint, and what it equals."""

import itertools
from functools import cache

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import refused, swept

from jaxslam import charts, motion, run, sensors, slots
from jaxslam.core.record import record
from jaxslam.core.slots import Joint
from jaxslam.core.types import Log, Scan
from jaxslam.filters import Closing, EkfSlam, Merging
from jaxslam.filters.map_management._merging import closest_pair, merge_landmarks
from jaxslam.life import Existence, Recency

EUCLIDEAN = charts.Euclidean()
MOTION = motion.PoseIncrement(np.diag([0.1, 0.1, 0.05]) ** 2)
SENSOR = sensors.RelativePosition(0.1**2 * np.eye(2))
KEY = jax.random.key(0)


def some_joint(seed=0, count=4):
    rng = np.random.default_rng(seed)
    root = 0.3 * rng.normal(size=(3 + 2 * count, 3 + 2 * count))
    alive = np.arange(count) != 1
    dead = np.concatenate([np.zeros(3, bool), np.repeat(~alive, 2)])
    cov = np.where(dead[:, None] | dead[None, :], np.eye(len(dead)), root @ root.T)
    landmarks = np.where(alive[:, None], rng.normal(size=(count, 2)), 0.0)
    parts = np.array([0.3, -0.2, 0.5]), landmarks, cov, alive, np.where(alive, np.arange(count), -1)
    return Joint(*parts, ())


MERGE = jax.jit(merge_landmarks, static_argnums=1, static_argnames="square_root")
CLOSEST = jax.jit(closest_pair, static_argnums=1, static_argnames="square_root")


def test_the_constraint_is_a_conditional_gaussian():
    joint = some_joint()
    merged = MERGE(joint, EUCLIDEAN, 0, 3)
    p = np.asarray(joint.cov)
    h = np.zeros((2, len(p)))
    h[:, 3:5], h[:, 9:11] = np.eye(2), -np.eye(2)
    gain = p @ h.T @ np.linalg.inv(h @ p @ h.T)
    x = np.concatenate([joint.pose, np.asarray(joint.landmarks).ravel()])
    x, p = x - gain @ h @ x, p - gain @ h @ p
    np.testing.assert_allclose(merged.pose, x[:3], atol=1e-12)
    np.testing.assert_allclose(np.asarray(merged.landmarks)[[0, 2]], x[3:].reshape(4, 2)[[0, 2]])
    np.testing.assert_allclose(x[3:5], x[9:11], atol=1e-12)
    keep = [0, 1, 2, 3, 4, 7, 8]
    np.testing.assert_allclose(merged.cov[np.ix_(keep, keep)], p[np.ix_(keep, keep)], atol=1e-12)
    assert list(merged.alive) == [True, False, True, False]
    np.testing.assert_array_equal(merged.cov[9:11], np.eye(2, 11, 9))


@pytest.mark.parametrize(
    "chart", swept(["euclidean", "right_invariant", "left_invariant"], "right_invariant")
)
def test_the_pair_is_found_by_its_own_covariance(chart):
    """d² of every pair by dense algebra in coordinates."""
    chart = charts.REGISTRY[chart]()
    joint = some_joint(3)
    i, j, distance = CLOSEST(joint, chart, 10.0)
    size = joint.cov.shape[0]

    def coordinates(xi):
        over = jax.vmap(chart.retract, in_axes=(None, 0, None, 0))
        return over(joint.pose, joint.landmarks, xi[:3], xi[3:].reshape(-1, 2))[1]

    slope = np.asarray(jax.jit(jax.jacfwd(coordinates))(np.zeros(size)))
    best = (np.inf, 0, 0)
    for a in range(4):
        for b in range(a + 1, 4):
            if joint.alive[a] and joint.alive[b]:
                h = slope[a] - slope[b]
                delta = np.asarray(joint.landmarks[a] - joint.landmarks[b])
                best = min(best, (delta @ np.linalg.solve(h @ joint.cov @ h.T, delta), a, b))
    assert (int(i), int(j)) == best[1:]
    np.testing.assert_allclose(distance, best[0])


def test_no_pair_within_reach():
    joint = some_joint()
    assert np.isinf(CLOSEST(joint, EUCLIDEAN, 1e-6)[2])
    nobody = np.zeros((4, 4), bool)
    i, j, distance = CLOSEST(joint, EUCLIDEAN, 10.0, nobody)
    assert (int(i), int(j)) == (0, 0)
    assert np.isinf(distance)
    same = MERGE(joint, EUCLIDEAN, i, j)
    chex.assert_trees_all_equal(same, joint)


@pytest.mark.sweep
@pytest.mark.parametrize("chart", ["euclidean", "right_invariant"])
def test_two_sightings_merged_are_one_landmark_seen_twice(chart):
    """With a linear sensor and no turn, starting anew and merging is the same as matching."""
    chart = charts.REGISTRY[chart]()

    def scan(tag, z):
        return Scan(np.array([z]), np.array([tag]), np.array([True]))

    # The heading is known: the model is linear, and order does not matter.
    still = EkfSlam(motion.PoseIncrement(np.diag([0.1, 0.1, 0.0]) ** 2), SENSOR, 3, chart=chart)
    update, predict = jax.jit(still.update), jax.jit(still.predict)
    start = jax.jit(still.init)(np.zeros(3), np.diag([0.2, 0.3, 0.0]) ** 2)
    joint = update(start, scan(0, [2.0, 1.0]), KEY)[0]
    joint = predict(joint, np.array([0.5, 0.0, 0.0]), KEY)
    matched = update(joint, scan(0, [1.4, 1.1]), KEY)[0]
    twice = update(joint, scan(5, [1.4, 1.1]), KEY)[0]
    i, j, distance = CLOSEST(twice, chart, 1.0)
    assert distance < 9
    merged = MERGE(twice, chart, i, j)
    np.testing.assert_allclose(merged.pose, matched.pose, atol=1e-12)
    np.testing.assert_allclose(merged.landmarks, matched.landmarks, atol=1e-12)
    np.testing.assert_allclose(merged.cov, matched.cov, atol=1e-12)


def test_a_square_root_is_merged_too():
    joint = some_joint()
    root = joint._replace(cov=np.linalg.cholesky(joint.cov))
    found = CLOSEST(root, EUCLIDEAN, 100.0, square_root=True)
    np.testing.assert_allclose(found, CLOSEST(joint, EUCLIDEAN, 100.0), rtol=1e-9)
    whole = MERGE(joint, EUCLIDEAN, 0, 2)
    merged = MERGE(root, EUCLIDEAN, 0, 2, square_root=True)
    cov = np.asarray(merged.cov)
    np.testing.assert_allclose(cov @ cov.T, whole.cov, atol=1e-12)
    assert jax.jit(slots.find)(merged.tag, merged.alive, np.array([0]))[1].all()


def seen_twice(together=False, steps=8, dtype=np.float64):
    """A robot that stands, and measures one landmark by tag 0, then by tag 2; and another, tag 1."""
    rng = np.random.default_rng(5)
    points = np.array([[2.0, 1.0], [3.0, -1.0], [2.0, 1.0]])
    tag = np.tile(np.array([0, 1, 2], np.int32), (steps, 1))
    valid = np.ones((steps, 3), bool)
    if not together:
        valid[:4, 2], valid[4:, 0] = False, False
    z = points[None] + 0.1 * rng.normal(size=(steps, 3, 2))
    scan = Scan(z.astype(dtype), np.where(valid, tag, -1), valid)
    return Log(np.zeros((steps, 3), dtype), scan)


def state_of(joint):
    return joint


@cache
def driver(reach=0.5, chart="euclidean", dtype=np.float64, **options):
    """A filter that merges within a reach, and its runs: by one program whatever the reach."""
    plain = EkfSlam(
        MOTION, SENSOR, 4, chart=charts.REGISTRY[chart](), correction="joint", **options
    )
    filter, start = Merging(plain, reach), (np.zeros(3, dtype), np.zeros((3, 3), dtype), KEY)
    return plain, lambda log: run(filter, log, *start, probe=state_of)


def state_at(trace, step):
    return jax.tree.map(lambda leaf: leaf[step], trace.probe)


def pairs_in(trace):
    return np.asarray(trace.info.extra["merging"].pair)


@pytest.mark.parametrize(
    "options",
    swept([{}, {"chart": "right_invariant"}, {"covariance": "square_root"}], {}),
)
def test_a_filter_merges_what_it_holds_twice(options):
    log = seen_twice()
    _, go = driver(**options)
    trace = go(log)
    merged = pairs_in(trace)
    at = int(np.argmax(merged[:, 0] >= 0))
    assert at >= 4 and list(merged[at]) == [0, 2]
    assert (merged[:at] == -1).all()
    assert not trace.estimate.alive[at, 2]
    # The same as the filter without, and a merge by hand.
    plain, go_plain = driver(1e-9, **options)
    never = go_plain(log)
    assert (pairs_in(never) == -1).all()
    before = state_at(never, at)
    chart = charts.REGISTRY[options.get("chart", "euclidean")]()
    square_root = plain.square_root
    by_hand = MERGE(before, chart, 0, 2, square_root=square_root)
    expected = jax.jit(plain.estimate)(by_hand)
    for name in ("pose", "pose_cov", "points", "point_covs"):
        actual = getattr(trace.estimate, name)[at]
        np.testing.assert_allclose(actual, getattr(expected, name), atol=1e-10)


def test_what_one_scan_measures_twice_is_two():
    _, go = driver()
    trace = go(seen_twice(together=True))
    assert (pairs_in(trace) == -1).all()
    assert trace.estimate.alive[-1, :3].all()
    together = np.asarray(trace.final.co_observed)
    np.testing.assert_array_equal(together[:3, :3], True)
    assert not together[3].any()


def test_what_was_measured_beside_either_is_another_than_the_merged():
    _, go = driver()
    trace = go(seen_twice())
    at = int(np.argmax(pairs_in(trace)[:, 0] >= 0))
    together = state_at(trace, at).co_observed
    assert together[0, 1] and together[1, 0]
    assert not together[2].any() and not together[:, 2].any()


def test_far_landmarks_and_none_are_left_alone():
    log = seen_twice()
    far = log._replace(scan=log.scan._replace(z=log.scan.z + np.array([[0, 0], [0, 0], [0, 1.0]])))
    _, go = driver()
    assert (pairs_in(go(far)) == -1).all()
    nothing = Scan(*(np.zeros_like(part) for part in log.scan))._replace(tag=log.scan.tag * 0 - 1)
    trace = go(log._replace(scan=nothing))
    assert (pairs_in(trace) == -1).all()
    assert np.isfinite(trace.final.cov).all()


@pytest.mark.sweep
def test_merging_in_float32_and_its_gradient():
    log = seen_twice(dtype=np.float32)
    _, go = driver(dtype=np.float32)

    def points(z):
        trace = go(log._replace(scan=log.scan._replace(z=z)))
        return trace.estimate.points, trace

    way = np.ones_like(log.scan.z)
    _, along, trace = jax.jit(lambda z: jax.jvp(points, (z,), (way,), has_aux=True))(log.scan.z)
    assert trace.final.cov.dtype == np.float32 and (pairs_in(trace)[:, 0] >= 0).any()
    assert np.isfinite(along).all()


@refused(
    (lambda: Merging(PLAIN, 0.0), r"^Merging: reach: expected a number above 0, got 0\.0"),
    (
        lambda: Merging(PLAIN, 1.0, probability=1.0),
        "^Merging: probability: expected a number above 0",
    ),
    (lambda: Merging(of_sensor(sensors.BearingInverseDepth(np.eye(1))), 0.5), "cannot be merged"),
    (lambda: Merging(of_sensor(sensors.Compass(np.eye(1))), 0.5), "cannot be merged"),
    (
        lambda: Merging(Poses(MOTION, SENSOR, 3), 0.5).init(np.zeros(3), np.eye(3)),
        r"^Merging: filter: expected one whose state is a slots\.Joint, as of EkfSlam,",
    ),
    (lambda: closest_pair(some_joint(), EUCLIDEAN, -1.0), "reach"),
    (lambda: closest_pair(some_joint(), EUCLIDEAN, 1.0, jnp.asarray(True)), "allowed"),
)
def test_refusals(make):
    make()


def of_sensor(sensor):
    return EkfSlam(MOTION, sensor, 3)


PLAIN = of_sensor(SENSOR)


@pytest.mark.sweep
def test_landmarks_that_differ_stay_two():
    """0.45 m apart, known to centimetres, and seen by turns: only their distance tells them apart.

    In square roots, whose closest pair is that of the covariance (above).
    """
    sensor = sensors.RangeBearing(np.diag([0.02, 0.01]) ** 2)
    filter = Merging(Still(MOTION, sensor, 4, covariance="square_root", correction="joint"), 0.5)
    z = np.array([[[2.0, 0.0]], [[2.0, 0.225]]] * 5)
    scan = Scan(z, np.array([[0], [1]] * 5, np.int32), np.ones((10, 1), bool))
    log = Log(np.zeros((10, 3)), scan)
    start = np.zeros(3), np.zeros((3, 3)), KEY
    trace = jax.jit(lambda log: run(filter, log, *start))(log)
    assert (pairs_in(trace) == -1).all()
    assert trace.estimate.alive[-1].sum() == 2


@record
class Still(EkfSlam):
    """Without the noise of motion, which would make the two one in the robot's eyes."""

    def predict(self, state, u, key):
        return state


@record
class Poses(EkfSlam):
    """One whose state is a pose."""

    def init(self, pose, pose_cov):
        return pose


# --- Map managers around one filter, in any order -------------------------------------------------


MANAGERS = {
    "merging": lambda filter: Merging(filter, 0.5),
    "closing": lambda filter: Closing(filter, reach=1.0),
}
ORDERS = [
    (life, order)
    for life in (None, Recency())
    for count in range(3)
    for order in itertools.permutations(MANAGERS, count)
    if life is not None or "closing" not in order
]
MODELS = motion.PoseIncrement(np.eye(3)), sensors.RelativePosition(np.eye(2))


@pytest.mark.parametrize(("life", "order"), swept(ORDERS, ORDERS[-1]))
def test_managers_compose_in_any_order(life, order):
    """Each keeps the state's structure, reports under its own name, and leaves the rest alone."""
    plain = filter = EkfSlam(*MODELS, 4, chart=charts.RightInvariant(), life=life)
    for name in order:
        filter = MANAGERS[name](filter)
    assert filter.name == " ".join((*order[::-1], "ekf_slam"))
    assert (filter.chart, filter.landmark) == (plain.chart, plain.landmark)
    state = filter.init(np.zeros(3), np.eye(3))
    assert (state.life is not None) == (life is not None)
    assert (state.co_observed is not None) == ("merging" in order)
    scan = Scan(np.zeros((2, 2)), np.full(2, -1), np.ones(2, bool))
    after, info = jax.eval_shape(filter.update, state, scan, jax.random.key(0))
    chex.assert_trees_all_equal_shapes_and_dtypes(after, state)
    assert set(info.extra or {}) == set(order) | ({"pruning"} if life is not None else set())


def test_closing_takes_times():
    for life in (None, Existence(lambda pose, landmark: True)):
        with pytest.raises(
            ValueError,
            match=r"^Closing: joint: expected that of a filter that keeps times, as EkfSlam\(…,",
        ):
            Closing(EkfSlam(*MODELS, 4, life=life)).init(np.zeros(3), np.eye(3))


@pytest.mark.parametrize("name", MANAGERS)
def test_a_class_is_no_filter(name):
    with pytest.raises(
        ValueError,
        match=rf"^{name.title()}: filter: expected a Filter, got the class EkfSlam: call it",
    ):
        MANAGERS[name](EkfSlam)
