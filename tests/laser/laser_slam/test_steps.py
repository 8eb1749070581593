"""Steps of raw odometry that cannot be right: late, frozen, jumps; and how far a robot can go."""

import dataclasses

import numpy as np
import pytest
from ring_of_rooms import SETTINGS, driven

from jaxslam.laser.laser_slam.odometry.raw import FARTHEST, steps_of
from jaxslam.math import numpy_poses as poses

COUNT = 60
TIME = 10.0 + 0.8 * np.arange(COUNT)


def path(turn=0.02, count=COUNT):
    """A robot of constant speed, 0.7 m a step, but for the noise of its odometry."""
    random = np.random.default_rng(3)
    step = np.array([0.7, 0.0, turn]) + random.normal(size=(count - 1, 3)) * [0.02, 0.005, 0.005]
    return poses.chain(np.array([2.0, -1.0, 0.4]), step)


def steps(raw):
    return poses.between(raw[:-1], raw[1:])


def late(raw, k, share=0.05):
    """The same path whose message at scan k says a part of the step; the one after it says all."""
    raw = np.array(raw)
    raw[k] = poses.compose(raw[k - 1], share * poses.between(raw[k - 1], raw[k]))
    return raw


def only(k, count=COUNT):
    return np.arange(count) == k


def diagonal(reach):
    """The covariance of σ = half of (far, far, turn)."""
    return np.diag(np.square(0.5 * np.array([reach[0], reach[0], reach[1]])))


@pytest.mark.parametrize("k", [1, 7, 30, COUNT - 2])
def test_a_message_that_comes_late_is_found_where_it_was_missing(k):
    raw = late(path(), k)
    found = steps_of(raw, SETTINGS, TIME)
    np.testing.assert_array_equal(found.lags, only(k))
    assert not found.unknown.any() and not found.gap.any()
    untimed = steps_of(raw, SETTINGS)
    np.testing.assert_array_equal(found.step, untimed.step)
    np.testing.assert_allclose(found.cov[k] - untimed.cov[k], diagonal(found.reach[k]), rtol=1e-9)
    np.testing.assert_array_equal(found.cov[~only(k)], untimed.cov[~only(k)])
    # 0.7 m in 0.8 s, and half as much again.
    assert found.reach[k, 0] == pytest.approx(1.5 * 0.7, rel=0.1)


@pytest.mark.parametrize("k", [5, 31])
def test_a_turn_that_comes_late_is_found(k):
    """It drives at the usual speed while its heading is late."""
    raw = path(turn=0.4)
    step = steps(raw)
    step[k - 1, 2], step[k, 2] = 0.01, step[k - 1, 2] + step[k, 2]
    found = steps_of(poses.chain(raw[0], step), SETTINGS, TIME)
    np.testing.assert_array_equal(found.lags, only(k))


def test_a_message_that_comes_late_at_a_gap_in_the_stamps_is_found():
    step = steps(path())
    time, k = TIME.copy(), 20
    time[k:] += 0.8  # two steps' time, of which the log says nothing, and three after it
    step[k - 1], step[k, 0] = [0.05, 0.0, 0.01], 3 * 0.7 - 0.05
    settings = dataclasses.replace(SETTINGS, jump=10.0)
    found = steps_of(poses.chain(np.zeros(3), step), settings, time)
    np.testing.assert_array_equal(found.lags, only(k))
    assert found.reach[k, 0] == pytest.approx(2 * 1.5 * 0.7, rel=0.1)


def test_without_stamps_no_step_is_late_and_all_that_is_searched_can_be_reached():
    raw = late(path(), 30)
    for time in (None, np.full(COUNT, 7.0)):
        found = steps_of(raw, SETTINGS, time)
        assert not found.lags.any() and not found.gap.any()
        np.testing.assert_array_equal(found.reach, np.broadcast_to(FARTHEST, (COUNT, 2)))


def test_a_robot_that_stops_and_starts_and_turns_on_the_spot_is_not_late():
    random = np.random.default_rng(4)
    go, stop, turn = [0.7, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.6]
    slow = [0.35, 0.0, 0.0]
    kinds = [go] * 6 + [slow] + [stop] * 4 + [slow] + [go] * 4 + [slow] + [turn] * 3 + [slow]
    step = np.array(kinds * 6, float)
    step[(step != 0).any(axis=1)] *= 1 + 0.05 * random.normal(size=((step != 0).any(1).sum(), 1))
    raw = poses.chain(np.zeros(3), step)
    time = 0.5 * np.arange(len(raw)) + 0.02 * random.normal(size=len(raw))
    found = steps_of(raw, SETTINGS, time, np.zeros(len(raw), bool))
    assert not found.lags.any() and not found.unknown.any()
    # And at full speed from one scan to the next, as a log of key scans has it.
    step = step[(step != slow).any(axis=1)]
    raw = poses.chain(np.zeros(3), step)
    assert not steps_of(raw, SETTINGS, np.arange(len(raw)) * 0.5).lags.any()


def test_the_ring_is_not_late():
    _, log = driven()
    found = steps_of(log.raw, SETTINGS, log.time, np.ones(len(log.time), bool))
    assert not found.lags.any() and not found.unknown.any() and not found.gap.any()


def test_odometry_is_frozen_where_it_says_nothing_while_scans_change():
    step = steps(path())
    step[19:23] = 0.0
    raw = poses.chain(np.zeros(3), step)
    # The composition of a pose with no step is rounded.
    raw[20:24] = raw[19]
    changed, known = np.ones(COUNT, bool), np.ones(COUNT, bool)
    at = np.isin(np.arange(COUNT), [20, 21, 22, 23])
    found = steps_of(raw, SETTINGS, TIME, changed, known)
    np.testing.assert_array_equal(found.frozen, at)
    np.testing.assert_array_equal(found.unknown, at)
    base = steps_of(raw, SETTINGS, TIME).cov
    for k in (20, 23):
        assert (found.cov[k] - base[k]).diagonal().min() > 0
        assert found.cov[k, 0, 0] < found.reach[k, 0] ** 2
    np.testing.assert_array_equal(found.cov[~at], base[~at])
    # A robot at rest sees the same scan again.
    assert not steps_of(raw, SETTINGS, TIME, ~at, known).frozen.any()
    assert not steps_of(raw, SETTINGS, TIME, None, None).frozen.any()
    # Where nothing was logged, it is frozen whatever the scan shows, but not at the first scan.
    np.testing.assert_array_equal(steps_of(raw, SETTINGS, TIME, ~at, ~at).frozen, at)
    none = steps_of(raw, SETTINGS, TIME, None, np.zeros(COUNT, bool))
    np.testing.assert_array_equal(none.frozen, ~only(0))


def test_a_jump_is_no_step_and_may_lead_anywhere():
    raw = path()
    raw[30:] += [40.0, -30.0, 0.0]
    found = steps_of(raw, SETTINGS, TIME, np.ones(COUNT, bool))
    np.testing.assert_array_equal(found.jump, only(30))
    np.testing.assert_array_equal(found.unknown, only(30))
    assert not found.frozen.any() and not found.lags.any()
    np.testing.assert_array_equal(found.step[30], 0.0)
    assert (found.cov[30].diagonal() >= diagonal(found.reach[30]).diagonal()).all()


def test_the_reach_grows_with_the_time_and_ends_where_is_searched():
    time = TIME.copy()
    time[40:] += 0.8
    time[50:] += 100.0
    found = steps_of(path(turn=0.1), SETTINGS, time)
    assert (found.reach <= FARTHEST).all() and (found.reach > 0).all()
    np.testing.assert_allclose(found.reach[40], 2 * found.reach[39], rtol=1e-9)
    np.testing.assert_array_equal(found.reach[50], FARTHEST)
    np.testing.assert_array_equal(found.gap, only(50))
    assert found.reach[39, 0] == pytest.approx(1.5 * 0.7, rel=0.1)
    assert found.reach[39, 1] == pytest.approx(1.5 * 0.1, rel=0.2)


def test_a_step_that_is_faster_than_can_be_and_makes_up_for_none_has_wrong_stamps():
    raw, time = path(), TIME.copy()
    time[30] = time[29] + 0.1
    found = steps_of(raw, SETTINGS, time)
    assert not found.lags.any()
    np.testing.assert_array_equal(found.reach[30], FARTHEST)
    assert (found.reach[29] < FARTHEST[0]).all()
