"""The life of a landmark: evidence for and against it, and what a filter does when it ends."""

import math
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import refused
from worlds import narrow

from jaxslam import life, motion, run, sensors, slots
from jaxslam.core.slots import Joint
from jaxslam.core.types import Log, Scan, Status
from jaxslam.filters import EkfSlam, Mapping
from jaxslam.life import Evidence

MOTION = motion.Increment(np.diag([0.02, 0.01]) ** 2)
SENSOR = sensors.RangeBearing(np.diag([0.05, 0.02]) ** 2)
POINTS = np.array([[2.0, 1.0], [3.0, -1.0], [1.0, 2.0], [-2.0, 0.5]])
KEY = jax.random.key(0)


UNSEEING = 100.0, 0.0, 0.0
"""A pose from which no landmark is expected to be measured; from others all are."""


def always(pose, landmark):
    return jnp.asarray(True)


def log_of(seen):
    """A robot that stands still and sees, without noise, the landmarks (T, M) tags; -1 for none."""
    seen = np.asarray(seen)
    z = np.stack([np.hypot(*POINTS.T), np.arctan2(*POINTS.T[::-1])], axis=1)
    scan = Scan(z[np.maximum(seen, 0)] * (seen >= 0)[..., None], seen.astype(np.int32), seen >= 0)
    return Log(np.zeros((len(seen), 2)), scan)


def managed(manager, capacity, **options):
    """An EKF whose landmarks live as the manager decides."""
    return EkfSlam(MOTION, SENSOR, capacity, life=manager, **options)


def removed_in(trace):
    return trace.info.extra["pruning"].removed


def late(rows, steps=12):
    """The scans of these tags, as the last of so many; before them nothing is seen."""
    seen = np.full((steps, 2), -1)
    seen[-len(rows) :] = rows
    return seen


def seen_by_turns(second, steps=12):
    """Landmark 0 in every scan, and another landmark in scans of its own: {scan or range: tag}."""
    seen = np.full((steps, 2), -1)
    seen[:, 0] = 0
    for at, tag in second.items():
        seen[at, 1] = tag
    return seen


@cache
def driver(replace=False, **options):
    """Drives a filter that removes landmarks for all reasons there are; with a map of 2 or 3 slots."""
    if replace:
        filter = managed(life.Existence(always, replace=True), 2)
    else:
        visible = lambda pose, landmark: pose[0] < UNSEEING[0] / 2  # noqa: E731
        filter = managed(life.Existence(visible, patience=5, spread=0.5), 3, **options)

    @jax.jit
    def go(log, pose, variance):
        pose_cov = variance * jnp.eye(3, dtype=pose.dtype)
        return run(filter, log, pose, pose_cov, KEY, probe=lambda joint: joint.life)

    return go


def driven(seen, pose=(0.0, 0.0, 0.0), variance=1e-4, **options):
    return jax.device_get(driver(**options)(log_of(seen), np.array(pose), variance))


def test_a_landmark_that_is_not_seen_again_is_removed_when_its_odds_say_so():
    seen = seen_by_turns({0: 1})
    trace = driven(seen)
    loss = math.log(0.1 / 0.9)
    misses = math.ceil(math.log(0.05 / 0.95) / loss)  # from even odds to a probability of 0.05
    removed = removed_in(trace)
    assert list(np.argwhere(removed)[0]) == [misses, 1]
    assert removed.sum() == 1
    assert list(trace.estimate.tag[-1]) == [0, -1, -1]
    kept = jax.tree.map(lambda x: x[:, 0], trace.probe)
    gain = math.log(0.9 / 0.1)
    np.testing.assert_allclose(kept.log_odds[:4], gain * np.arange(4))
    np.testing.assert_array_equal(kept.confirmed, kept.log_odds >= math.log(0.95 / 0.05))
    assert int(kept.seen[-1]) == 12
    assert not np.asarray(kept.missed).any()
    gone = jax.tree.map(lambda x: x[-1, 1:], trace.probe)
    assert not any(np.asarray(leaf).any() for leaf in gone)


def test_what_is_left_is_the_marginal():
    seen = seen_by_turns({0: 1})
    with_life = driven(seen).final
    start = np.zeros(3), np.eye(3) * 1e-4, KEY
    without = run(EkfSlam(MOTION, SENSOR, 3), log_of(seen), *start).final
    marginal = jax.jit(slots.remove)(without, np.array([False, True, False]))
    np.testing.assert_allclose(with_life.cov, marginal.cov, atol=1e-14)
    np.testing.assert_allclose(with_life.landmarks, marginal.landmarks, atol=1e-14)


def test_a_removed_landmark_can_come_back_and_begins_anew():
    seen = seen_by_turns({0: 1, range(8, 12): 1})
    trace = driven(seen)
    assert trace.info.status[8, 1] == Status.BORN
    assert int(trace.probe.seen[-1, 1]) == 4
    assert bool(trace.estimate.alive[-1, 1])


def test_patience_is_for_the_provisional_alone():
    seen = np.full((12, 2), -1)
    seen[:3, 0], seen[0, 1] = 0, 1
    trace = driven(seen, UNSEEING)
    assert list(np.argwhere(removed_in(trace))[0]) == [5, 1]
    assert list(trace.estimate.alive[-1]) == [True, False, False]


def test_a_landmark_known_too_badly_is_removed():
    seen = late([[0, 1]])
    exact = driven(seen)
    assert not removed_in(exact).any()
    lost = driven(seen, variance=1.0)
    np.testing.assert_array_equal(removed_in(lost)[-1], [True, True, False])
    np.testing.assert_array_equal(lost.final.cov[3:, 3:], np.eye(6))


def test_a_full_map_refuses_or_gives_up_the_least_likely():
    # 0 is confirmed, 1 provisional and missed once, 2 comes into a map of two.
    trace = driven(late([[0, 1], [0, -1], [0, 2]]), replace=True)
    assert trace.info.status[-1, 1] == Status.BORN
    np.testing.assert_array_equal(removed_in(trace)[-1], [False, True])
    assert list(trace.estimate.tag[-1]) == [0, 2]
    assert int(trace.final.life.seen[1]) == 1
    # 0 and 1 are provisional and missed, 3 and 2 come into a map of three.
    trace = driven(late([[0, 1], [3, 2]]))
    assert list(trace.info.status[-1]) == [Status.BORN, Status.OVERFLOW]
    assert list(trace.estimate.tag[-1]) == [0, 1, 3]


def test_a_full_map_of_confirmed_landmarks_refuses_in_any_case():
    trace = driven(late([[0, 1], [0, 1], [0, 1], [0, 2]]), replace=True)
    assert trace.final.life.confirmed.all()
    assert trace.info.status[-1, 1] == Status.OVERFLOW
    assert not removed_in(trace).any()


@pytest.mark.sweep
def test_gradients_pass_through_births_and_deaths():
    log = log_of(seen_by_turns({0: 1, 5: 2}, steps=8))

    def loss(sigma):
        sensor = sensors.RangeBearing(jnp.diag(jnp.stack([sigma, 0.02])) ** 2)
        rule = life.Existence(always)
        filter = EkfSlam(MOTION, sensor, 3, correction="joint", life=rule)
        trace = run(filter, log, np.zeros(3), np.eye(3) * 1e-4, KEY)
        likely = trace.info.log_likelihood.sum()
        return likely + (trace.estimate.points[-1] ** 2).sum(), removed_in(trace)

    both = jax.jit(jax.value_and_grad(loss, has_aux=True))
    (_, removed), slope = both(0.05)
    assert removed.any()
    rise = both(0.05 + 1e-6)[0][0] - both(0.05 - 1e-6)[0][0]
    np.testing.assert_allclose(slope, rise / 2e-6, rtol=1e-5)


@pytest.mark.sweep
def test_batches_and_float32():
    each = [log_of(seen_by_turns(second)) for second in ({0: 1}, {range(3, 12): 2})]
    logs = jax.tree.map(lambda *x: np.stack(x), *each)
    small = (*narrow((logs, np.zeros(3))), 1e-4)
    batch = jax.device_get(jax.vmap(driver(), (0, None, None))(*small))
    assert batch.probe.log_odds.dtype == np.float32
    for i in range(2):
        alone = jax.device_get(driver()(each[i], np.zeros(3), 1e-4))
        np.testing.assert_array_equal(removed_in(batch)[i], removed_in(alone))
        np.testing.assert_array_equal(batch.estimate.tag[i], alone.estimate.tag)


@pytest.mark.sweep
def test_a_root_does_not_change_because_another_run_loses_a_landmark():
    one, other = log_of(seen_by_turns({0: 1})), log_of(seen_by_turns({}))
    go = jax.vmap(driver(covariance="square_root"), (0, None, None))
    beside, twice = (
        go(jax.tree.map(lambda *x: np.stack(x), first, other), np.zeros(3), 1e-4)
        for first in (one, other)
    )
    assert removed_in(beside)[0].any()
    np.testing.assert_array_equal(beside.final.cov[1], twice.final.cov[1])


def test_nothing_ever_seen():
    trace = driven(np.full((12, 2), -1))
    assert not removed_in(trace).any()
    assert not trace.estimate.alive.any()


def test_making_room_takes_the_least_likely_provisional_ones():
    manager = life.Existence(always, replace=True)
    alive = np.array([True, True, True, False])
    memory = Evidence(
        np.array([-1.0, -2.0, 3.0, 0.0]), np.array([False, False, True, False]), 0, 0, 0
    )
    joint = Joint(0, 0, 0, alive, 0, 0, life=memory)
    make_room = jax.jit(manager.make_room)
    none = np.zeros(4, bool)
    for needed, slots_given_up in ((-1, []), (0, []), (1, [1]), (2, [0, 1]), (4, [0, 1])):
        given_up = make_room(joint, needed, none)
        assert list(np.flatnonzero(given_up)) == slots_given_up
    given_up = make_room(joint, 2, np.arange(4) == 1)
    assert list(np.flatnonzero(given_up)) == [0]


def test_a_landmark_that_the_scan_measured_stays_in_a_full_map():
    """Though it has been seen no more often than the one that gives way."""
    trace = driven(late([[0, 1], [0, 2], [0, -1]]), variance=0.0, replace=True)
    assert (trace.info.status[-2:, 0] == Status.FUSED).all()
    removed = [[False, False], [False, True], [False] * 2]
    np.testing.assert_array_equal(removed_in(trace)[-3:], removed)
    np.testing.assert_array_equal(trace.estimate.tag[-1], [0, 2])


def test_a_full_map_loses_only_as_many_landmarks_as_start():
    """A repeated and a deferred measurement need no slot."""
    rule = life.Existence(always, replace=True)
    log = log_of([[0, 1, -1], [0, 1, -1], [2, 2, 3]])
    path = np.zeros((3, 3))  # the control of mapping is the pose
    for filter, control in (
        (managed(rule, 2, births=1), log.control),
        (Mapping(SENSOR, 2, life=rule, births=1), path),
    ):
        start = np.zeros(3), np.eye(3) * 1e-4, KEY
        # Jitted: outside of a trace `run` refuses a log in which a tag repeats within a scan.
        trace = jax.jit(partial(run, filter))(log._replace(control=control), *start)
        wanted = [Status.BORN, Status.REPEATED, Status.DEFERRED]
        assert list(trace.info.status[-1]) == wanted, filter.name
        # 0 was measured once more than 1, and is more likely to exist.
        np.testing.assert_array_equal(removed_in(trace)[-1], [False, True], filter.name)
        np.testing.assert_array_equal(trace.estimate.tag[-1], [0, 2], filter.name)


def test_what_is_no_manager_is_refused():
    with pytest.raises(ValueError, match="function"):
        life.Existence(None)
    with pytest.raises(ValueError, match="EkfSlam: life: expected a Life, got the class Exi"):
        EkfSlam(MOTION, SENSOR, 3, life=life.Existence)


@refused(
    ({"detected": 1.0}, "detected"),
    ({"detected": 0.1, "false": 0.2}, "detected"),
    ({"confirm": 0.4}, "confirm"),
    ({"remove": 0.0}, "remove"),
    ({"patience": 0}, "patience"),
    ({"spread": 0.0}, "spread"),
)
def test_refusals(options):
    life.Existence(always, **options)
