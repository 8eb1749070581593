"""Laser odometry where raw odometry lies for a moment, or says nothing, against the true path."""

import dataclasses

import jax
import numpy as np
import pytest
from cases import swept
from ring_of_rooms import SETTINGS, driven, errors, odometry_of, ranges_of, scans_of, steps_of

from jaxslam import laser_slam
from jaxslam.core.types import Beams
from jaxslam.laser.laser_slam import _odometry
from jaxslam.laser.matching import Points
from jaxslam.math import numpy_poses as poses
from jaxslam.math._odometry_jumps import odometry_jumps, without_jumps

COUNT = 40
CORNERS = [6, 12, 18, 24, 30, 36]
"""Scans to which the robot drove a metre and turned by 90°."""


@pytest.fixture(scope="module")
def drive():
    """(true path, log, its scans)"""
    true, log = driven(COUNT)
    return true, log, scans_of(log)


def solved(drive, raw=None, scans=None, odometry_known=None):
    """The steps, and the odometry from the true first pose on."""
    true, log, all_scans = drive
    scans = all_scans if scans is None else scans
    steps = steps_of(log.raw if raw is None else raw, log.time, scans.changed, odometry_known)
    return steps, odometry_of(scans, steps, true[0])


def nees(odometry, true, k):
    """Of a scan in the frame of the keyframe before it."""
    off = relative_error(odometry, true, k)
    return off @ np.linalg.solve(odometry.cov[k], off)


def relative_error(odometry, true, k):
    return poses.between(poses.between(true[odometry.base[k]], true[k]), odometry.z[k])


def late(raw, k, share=0.05):
    """The same path whose message at scan k says a part of the step; the one after it says all."""
    raw = np.array(raw)
    raw[k] = poses.compose(raw[k - 1], share * poses.between(raw[k - 1], raw[k]))
    return raw


def check_late(drive, k, share):
    true, log, _ = drive
    steps, odometry = solved(drive, late(log.raw, k, share))
    position, heading = errors(odometry.poses, true)
    others = np.arange(COUNT) != k
    # Without loops the path drifts by a tenth of a metre, whatever a single step does.
    assert position[others].max() < 0.2 and heading[others].max() < np.deg2rad(5), k
    assert nees(odometry, true, k) < 20
    assert position[k] < 0.3 or not odometry.matched[k]
    return steps


@pytest.mark.sweep
def test_a_log_in_pieces_has_the_path_of_one(drive, monkeypatch):
    true, _, _ = drive
    _, unbroken = solved(drive)
    monkeypatch.setattr(_odometry.log_odometry, "PIECE", 13)
    _, odometry = solved(drive)
    inner = sorted({13, 26} & set(odometry.keyframe.tolist()))
    assert inner == [13, 26], "the first scan of a piece is a keyframe"
    assert (odometry.base[1:] < np.arange(1, COUNT)).all() and odometry.matched[1:].all()
    for path in (unbroken.poses, odometry.poses):
        position, heading = errors(path, true)
        assert position.max() < 0.2 and heading.max() < np.deg2rad(5)
    chained = poses.compose(odometry.poses[odometry.base[1:]], odometry.z[1:])
    np.testing.assert_allclose(chained, odometry.poses[1:], atol=1e-9)


@pytest.mark.sweep
def test_an_interrupt_ends_all_pieces(drive, monkeypatch):
    _, log, scans = drive
    monkeypatch.setattr(_odometry.log_odometry, "PIECE", 10)
    steps, calls = steps_of(log.raw), []

    def progress(done, of):
        calls.append(done)
        if len(calls) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        odometry_of(scans, steps, log.raw[0], progress)
    assert len(calls) < 10


@pytest.mark.parametrize("k", swept([3, 10, 21, 29, 38], 10))
def test_a_message_that_comes_late_moves_no_scan(drive, k):
    steps = check_late(drive, k, 0.05)
    np.testing.assert_array_equal(np.flatnonzero(steps.lags), [k])


@pytest.mark.parametrize("k", swept([3, 10, 21, 29, 38], 10))
def test_a_message_that_is_missing_and_comes_with_the_next_moves_no_scan(drive, k):
    """Odometry repeats a pose while the scan changes, and makes up for it: it is not lost."""
    steps = check_late(drive, k, 0.0)
    np.testing.assert_array_equal(np.flatnonzero(steps.frozen), [k])


@pytest.mark.parametrize("share", swept([0.05, 0.0], 0.05))
@pytest.mark.parametrize("k", swept(CORNERS, 12))
def test_a_turn_that_comes_late_bends_nothing(drive, k, share):
    """By its speed it cannot be told: the robot turns as fast at every corner."""
    check_late(drive, k, share)


@pytest.mark.parametrize("k", swept([3, 15, 27], 15))
@pytest.mark.parametrize(
    "wrong", swept([[1.8, 0.0, 0.0], [0.0, 1.5, 0.0], [0.0, 0.0, 1.2]], [0.0, 0.0, 1.2])
)
def test_a_single_wrong_pose_of_raw_odometry_moves_no_other_scan(drive, k, wrong):
    """The scan itself may match a place that looks alike, in doubt."""
    true, log, _ = drive
    raw = log.raw.copy()
    raw[k] = poses.compose(raw[k], np.array(wrong))
    _, odometry = solved(drive, raw)
    position, _ = errors(odometry.poses, true)
    assert np.delete(position, k).max() < 0.2
    assert position[k] < 0.2 or odometry.doubted[k]
    assert nees(odometry, true, k) < 20


ANEW = {
    "to zero": lambda raw: poses.between(raw[0], raw),
    "spike above the limit": lambda raw: poses.compose(raw[:1], np.array([2.1, 0.0, 0.0])),
    "spike below the limit": lambda raw: poses.compose(raw[:1], np.array([1.5, 1.0, 3.0])),
}


@pytest.mark.parametrize("k", swept([10, 21, 27], 27))
@pytest.mark.parametrize("how", swept(list(ANEW), "to zero", "spike above the limit"))
def test_odometry_that_is_set_anew_moves_no_scan(drive, how, k):
    true, log, _ = drive
    raw = log.raw.copy()
    new = ANEW[how](raw[k:])
    raw[k : k + len(new)] = new
    steps, odometry = solved(drive, raw)
    position, heading = errors(odometry.poses, true)
    assert position.max() < 0.2 and heading.max() < np.deg2rad(5)
    assert steps.jump[k] or odometry.refuted[k] or odometry.doubted[k]
    assert not (odometry.refuted & ~steps.odd).any()


@pytest.mark.parametrize("first", swept([4, 15, 23, 33], 15))
def test_odometry_that_is_frozen_for_some_steps_is_found_by_the_scans(drive, first):
    """What the robot drove meanwhile is lost to raw odometry for good."""
    true, log, _ = drive
    step = poses.between(log.raw[:-1], log.raw[1:])
    step[first - 1 : first + 3] = 0.0
    at = np.arange(first, first + 4)
    certain = ~np.isin(np.arange(COUNT), at)
    steps, odometry = solved(drive, poses.chain(true[0], step), odometry_known=certain)
    np.testing.assert_array_equal(steps.frozen, ~certain)
    assert odometry.matched[at].all()
    assert errors(odometry.poses, true)[0].max() < 0.2
    assert max(nees(odometry, true, k) for k in at) < 30


def test_odometry_that_is_frozen_on_the_whole_drive(drive):
    """Steps of a metre; at a corner the step before is no guess, and the place looks alike if it is
    turned by 90°, so that there a match may be wrong."""
    true, log, _ = drive
    raw, certain = np.zeros((COUNT, 3)), np.arange(COUNT) == 0
    steps, odometry = solved(drive, raw, odometry_known=certain)
    assert steps.frozen[1:].all() and not steps.jump.any()
    off = np.array([relative_error(odometry, true, k) for k in range(1, COUNT)])
    right = (np.hypot(off[:, 0], off[:, 1]) < 0.2) & (np.abs(off[:, 2]) < np.deg2rad(6))
    turns = np.isin(np.arange(1, COUNT), [*CORNERS, *(k + 1 for k in CORNERS)])
    assert right[~turns].mean() > 0.9
    assert right.mean() > 0.75
    assert (
        odometry.doubted[1:].sum() >= 4 and (odometry.cov[1:].diagonal(axis1=1, axis2=2) > 0).all()
    )


@pytest.mark.sweep
def test_frozen_and_late_steps_are_counted(drive):
    true, log, _ = drive
    step = poses.between(log.raw[:-1], log.raw[1:])
    step[[14, 15]] = 0.0
    raw = late(poses.chain(true[0], step), 28)
    told = log._replace(raw=raw, odometry_known=~np.isin(np.arange(COUNT), [15, 16]))
    counts = laser_slam.solve(told, dataclasses.replace(SETTINGS, rounds=1)).counts
    assert counts["steps in which raw odometry is frozen"] == 2
    assert counts["steps in which raw odometry lags"] == 1
    assert counts["jumps of raw odometry"] == counts["scans by raw odometry alone"] == 0


@pytest.mark.parametrize("k", swept([2, 14, 22, 30], 14))
def test_a_scan_without_points_stays_where_raw_odometry_leads(drive, k):
    true, log, every = drive
    scans = jax.tree.map(np.array, every)
    scans.points.valid[k], scans.usable[k] = False, False
    _, odometry = solved(drive, scans=scans)
    assert not odometry.matched[k] and k not in odometry.keyframe
    step = poses.between(log.raw[k - 1], log.raw[k])
    np.testing.assert_allclose(
        odometry.poses[k], poses.compose(odometry.poses[k - 1], step), atol=1e-9
    )
    assert np.delete(odometry.matched[1:], k - 1).all()
    assert np.delete(errors(odometry.poses, true)[0], k).max() < 0.2
    assert nees(odometry, true, k) < 20


@pytest.mark.parametrize("k", swept([5, 16, 25], 16))
def test_a_scan_that_matches_nothing_before_is_placed_by_what_comes_after(drive, monkeypatch, k):
    """Raw odometry is wrong at it alone. The others are as if it had no points."""
    true, log, all_scans = drive
    raw = log.raw.copy()
    raw[k] = poses.compose(raw[k], np.array([-0.4, 0.5, 0.3]))
    refused = np.asarray(all_scans.points.position)[k]
    match = _odometry.tracking._match_about

    def refusing(reference, points, *rest):
        odometry = match(reference, points, *rest)
        same = np.array_equal(points.position, refused)
        return odometry._replace(accepted=odometry.accepted and not same)

    monkeypatch.setattr(_odometry.tracking, "_match_about", refusing)
    _, odometry = solved(drive, raw)
    assert k not in odometry.keyframe and odometry.matched[k]
    assert np.linalg.norm(poses.between(raw[k - 1], raw[k]) - [1.0, 0.0, 0.0]) > 0.4
    assert errors(odometry.poses, true)[0].max() < 0.2
    assert np.hypot(*relative_error(odometry, true, k)[:2]) < 0.1
    assert nees(odometry, true, k) < 20
    # With nothing but the scans before it, it stays where raw odometry leads.
    monkeypatch.setattr(_odometry.log_odometry, "place_unmatched", lambda *_: None)
    _, alone = solved(drive, raw)
    assert k not in alone.keyframe and not alone.matched[k]
    others = np.arange(COUNT) != k
    np.testing.assert_array_equal(alone.poses[others], odometry.poses[others])
    step = poses.between(raw[k - 1], raw[k])
    np.testing.assert_allclose(
        alone.poses[k], poses.compose(odometry.poses[k - 1], step), atol=1e-9
    )


# --- Steps of raw odometry that cannot be right: late, frozen, jumps; and how far a robot can go --


LENGTH = 60
TIME = 10.0 + 0.8 * np.arange(LENGTH)


def path(turn=0.02, count=LENGTH):
    """A robot of constant speed, 0.7 m a step, but for the noise of its odometry."""
    random = np.random.default_rng(3)
    step = np.array([0.7, 0.0, turn]) + random.normal(size=(count - 1, 3)) * [0.02, 0.005, 0.005]
    return poses.chain(np.array([2.0, -1.0, 0.4]), step)


def steps(raw):
    return poses.between(raw[:-1], raw[1:])


def only(k, count=LENGTH):
    return np.arange(count) == k


def diagonal(reach):
    """The covariance of σ = half of (far, far, turn)."""
    return np.diag(np.square(0.5 * np.array([reach[0], reach[0], reach[1]])))


@pytest.mark.parametrize("k", [1, 7, 30, LENGTH - 2])
def test_a_message_that_comes_late_is_found_where_it_was_missing(k):
    raw = late(path(), k)
    raw_steps = steps_of(raw, TIME)
    np.testing.assert_array_equal(raw_steps.lags, only(k))
    assert not raw_steps.unknown.any() and not raw_steps.gap.any()
    untimed = steps_of(raw)
    np.testing.assert_array_equal(raw_steps.step, untimed.step)
    np.testing.assert_allclose(
        raw_steps.cov[k] - untimed.cov[k], diagonal(raw_steps.reach[k]), rtol=1e-9
    )
    np.testing.assert_array_equal(raw_steps.cov[~only(k)], untimed.cov[~only(k)])
    # 0.7 m in 0.8 s, and half as much again.
    assert raw_steps.reach[k, 0] == pytest.approx(1.5 * 0.7, rel=0.1)


@pytest.mark.parametrize("k", [5, 31])
def test_a_turn_that_comes_late_is_found(k):
    """It drives at the usual speed while its heading is late."""
    raw = path(turn=0.4)
    step = steps(raw)
    step[k - 1, 2], step[k, 2] = 0.01, step[k - 1, 2] + step[k, 2]
    raw_steps = steps_of(poses.chain(raw[0], step), TIME)
    np.testing.assert_array_equal(raw_steps.lags, only(k))


def test_a_message_that_comes_late_at_a_gap_in_the_stamps_is_found():
    step = steps(path())
    time, k = TIME.copy(), 20
    time[k:] += 0.8  # two steps' time, of which the log says nothing, and three after it
    step[k - 1], step[k, 0] = [0.05, 0.0, 0.01], 3 * 0.7 - 0.05
    settings = dataclasses.replace(SETTINGS, jump=10.0)
    raw_steps = steps_of(poses.chain(np.zeros(3), step), time, settings=settings)
    np.testing.assert_array_equal(raw_steps.lags, only(k))
    assert raw_steps.reach[k, 0] == pytest.approx(2 * 1.5 * 0.7, rel=0.1)


def test_without_stamps_no_step_is_late_and_all_that_is_searched_can_be_reached():
    raw = late(path(), 30)
    for time in (None, np.full(LENGTH, 7.0)):
        raw_steps = steps_of(raw, time)
        assert not raw_steps.lags.any() and not raw_steps.gap.any()
        np.testing.assert_array_equal(
            raw_steps.reach, np.broadcast_to(_odometry.raw.FARTHEST, (LENGTH, 2))
        )


def test_a_robot_that_stops_and_starts_and_turns_on_the_spot_is_not_late():
    random = np.random.default_rng(4)
    go, stop, turn = [0.7, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.6]
    slow = [0.35, 0.0, 0.0]
    kinds = [go] * 6 + [slow] + [stop] * 4 + [slow] + [go] * 4 + [slow] + [turn] * 3 + [slow]
    step = np.array(kinds * 6, float)
    step[(step != 0).any(axis=1)] *= 1 + 0.05 * random.normal(size=((step != 0).any(1).sum(), 1))
    raw = poses.chain(np.zeros(3), step)
    time = 0.5 * np.arange(len(raw)) + 0.02 * random.normal(size=len(raw))
    raw_steps = steps_of(raw, time, np.zeros(len(raw), bool))
    assert not raw_steps.lags.any() and not raw_steps.unknown.any()
    # And at full speed from one scan to the next, as a log of key scans has it.
    step = step[(step != slow).any(axis=1)]
    raw = poses.chain(np.zeros(3), step)
    assert not steps_of(raw, np.arange(len(raw)) * 0.5).lags.any()


def test_the_ring_is_not_late():
    _, log = driven()
    raw_steps = steps_of(log.raw, log.time, np.ones(len(log.time), bool))
    assert not raw_steps.lags.any() and not raw_steps.unknown.any() and not raw_steps.gap.any()


def test_odometry_is_frozen_where_it_says_nothing_while_scans_change():
    step = steps(path())
    step[19:23] = 0.0
    raw = poses.chain(np.zeros(3), step)
    # The composition of a pose with no step is rounded.
    raw[20:24] = raw[19]
    changed, certain = np.ones(LENGTH, bool), np.ones(LENGTH, bool)
    at = np.isin(np.arange(LENGTH), [20, 21, 22, 23])
    raw_steps = steps_of(raw, TIME, changed, certain)
    np.testing.assert_array_equal(raw_steps.frozen, at)
    np.testing.assert_array_equal(raw_steps.unknown, at)
    base = steps_of(raw, TIME).cov
    for k in (20, 23):
        assert (raw_steps.cov[k] - base[k]).diagonal().min() > 0
        assert raw_steps.cov[k, 0, 0] < raw_steps.reach[k, 0] ** 2
    np.testing.assert_array_equal(raw_steps.cov[~at], base[~at])
    # A robot at rest sees the same scan again.
    assert not steps_of(raw, TIME, ~at, certain).frozen.any()
    assert not steps_of(raw, TIME, None, None).frozen.any()
    # Where nothing was logged, it is frozen whatever the scan shows, but not at the first scan.
    np.testing.assert_array_equal(steps_of(raw, TIME, ~at, ~at).frozen, at)
    none = steps_of(raw, TIME, None, np.zeros(LENGTH, bool))
    np.testing.assert_array_equal(none.frozen, ~only(0))


def turning(count=120):
    """6 cm and 3° in 0.2 s, a circle of 1.2 m that begins off the pose zero."""
    return poses.chain(np.array([0.0, -1.2, 0.0]), np.tile([0.06, 0.0, 0.05], (count - 1, 1)))


CLOCK = 0.2 * np.arange(120)


@pytest.mark.parametrize(
    ("change", "jumps"),
    [
        (lambda path: path, []),
        (lambda path: np.concatenate([path[:60], poses.between(path[60], path[60:])]), [60]),
        (lambda path: np.concatenate([path[:60], poses.compose(poses.compose(path[60], np.array([0, 0, 1.5])), poses.between(path[60], path[60:]))]), [60]),
        (lambda path: np.concatenate([path[:60], path[60:] + [1.0, 0.5, 0.0]]), [60]),
        (lambda path: np.concatenate([path[:60], path[60:61] + [0, 2.0, 0.0], path[61:]]), [60, 61]),
    ],
)  # fmt: skip
def test_steps_that_no_robot_makes(change, jumps):
    path = change(turning())
    np.testing.assert_array_equal(np.flatnonzero(odometry_jumps(path, CLOCK)), jumps)
    # Without them only the steps over them are not those of the log.
    rest = without_jumps(path, odometry_jumps(path, CLOCK))
    np.testing.assert_allclose(steps(rest), steps(turning()), atol=1e-9)


def test_a_return_to_zero_is_a_jump_at_any_rate():
    """By its speed alone, a metre a second, it could be motion."""
    path, time = turning(), 1.0 * np.arange(120)
    away, back = path.copy(), path.copy()
    back[30:] = poses.between(path[30], path[30:])
    away[30:] = poses.compose(np.array([-1.0, 0.4, 1.0]), back[30:])
    np.testing.assert_array_equal(np.flatnonzero(odometry_jumps(back, time)), [30])
    assert not odometry_jumps(away, time).any()


def test_fast_robots_and_rough_stamps_do_not_jump():
    random = np.random.default_rng(5)
    car = poses.chain(np.zeros(3), np.tile([3.0, 0.0, 0.02], (99, 1)))
    assert not odometry_jumps(car, 0.2 * np.arange(100)).any()  # 15 m/s
    # A turn on the spot at 170°/s after a straight drive with little noise.
    step = np.array([[0.1, 0.0, 0.0]] * 95 + [[0.0, 0.0, np.deg2rad(34)]] * 4)
    step[:95, 2] = 0.005 * random.normal(size=95)
    path = poses.chain(np.zeros(3), step)
    assert not odometry_jumps(path, 0.2 * np.arange(100)).any()
    # Messages that come in bursts, and a loop that ends at the pose zero.
    burst = np.repeat(0.8 * np.arange(25), 4) + 1e-3 * np.tile(np.arange(4), 25)
    ring = poses.chain(np.zeros(3), np.tile([0.4, 0.0, 2 * np.pi / 50], (100, 1)))
    assert not odometry_jumps(ring[:100], burst).any()
    assert not odometry_jumps(ring, np.arange(101.0)).any()
    for time in (None, np.zeros(101)):
        assert not odometry_jumps(ring, time).any()


def test_a_jump_that_a_reader_found_is_one_where_the_step_is_too_long():
    """Two messages apart by a jump: the scan between has the pose of the first."""
    raw = path()
    raw[30:] = poses.compose(
        poses.compose(raw[30], np.array([1.0, 0, 0])), poses.between(raw[30], raw[30:])
    )
    certain = ~only(30)
    raw_steps = steps_of(raw, TIME, None, certain)
    np.testing.assert_array_equal(raw_steps.jump, only(30))
    assert not raw_steps.frozen.any()
    np.testing.assert_array_equal(steps_of(path(), TIME, None, certain).frozen, only(30))


def test_frozen_odometry_of_a_slow_robot_is_counted():
    """No scan differs from the one before it, but from those four back."""
    raw = path()
    raw[20:40] = raw[19]
    changed = np.where(np.arange(LENGTH) >= 4, 4, 0)
    raw_steps = steps_of(raw, TIME, changed)
    np.testing.assert_array_equal(raw_steps.frozen, np.isin(np.arange(LENGTH), np.arange(20, 40)))
    assert not steps_of(raw, TIME, np.zeros(LENGTH, int)).frozen.any()


def test_scans_of_a_slow_robot_differ_from_those_some_back():
    angles = np.linspace(-np.pi, np.pi, 90, endpoint=False)
    true = poses.chain(np.array([-1.0, 0.0, 0.0]), np.tile([0.05, 0.0, 0.0], (19, 1)))
    true = np.concatenate([np.repeat(true[:1], 10, axis=0), true])
    ranges = np.array([ranges_of(pose, angles, WALLS) for pose in true])
    beams = Beams(ranges, np.broadcast_to(angles, ranges.shape), np.ones(ranges.shape, bool))
    log = laser_slam.ScanLog(np.arange(30.0), beams, 0 * true, 8.0)
    changed = scans_of(log).changed
    assert not changed[1:10].any() and (changed[20:] > 1).all() and changed.max() <= 8
    frozen = steps_of(0 * true, log.time, changed).frozen
    assert frozen[11:].all() and not frozen[:7].any()


def test_a_jump_is_no_step_and_may_lead_anywhere():
    raw = path()
    raw[30:] += [3.2, -2.0, 0.0]
    raw_steps = steps_of(raw, TIME, np.ones(LENGTH, bool))
    assert not raw_steps.reset.any()
    np.testing.assert_array_equal(raw_steps.jump, only(30))
    np.testing.assert_array_equal(raw_steps.unknown, only(30))
    assert not raw_steps.frozen.any() and not raw_steps.lags.any()
    np.testing.assert_array_equal(raw_steps.step[30], 0.0)
    assert (raw_steps.cov[30].diagonal() >= diagonal(raw_steps.reach[30]).diagonal()).all()


def test_the_reach_grows_with_the_time_and_ends_where_is_searched():
    time = TIME.copy()
    time[40:] += 0.8
    time[50:] += 100.0
    raw_steps = steps_of(path(turn=0.1), time)
    assert (raw_steps.reach <= _odometry.raw.FARTHEST).all() and (raw_steps.reach > 0).all()
    np.testing.assert_allclose(raw_steps.reach[40], 2 * raw_steps.reach[39], rtol=1e-9)
    np.testing.assert_array_equal(raw_steps.reach[50], _odometry.raw.FARTHEST)
    np.testing.assert_array_equal(raw_steps.gap, only(50))
    assert raw_steps.reach[39, 0] == pytest.approx(1.5 * 0.7, rel=0.1)
    assert raw_steps.reach[39, 1] == pytest.approx(1.5 * 0.1, rel=0.2)


def test_a_step_that_is_faster_than_can_be_and_makes_up_for_none_has_wrong_stamps():
    raw, time = path(), TIME.copy()
    time[30] = time[29] + 0.1
    raw_steps = steps_of(raw, time)
    assert not raw_steps.lags.any()
    np.testing.assert_array_equal(raw_steps.reach[30], _odometry.raw.FARTHEST)
    assert (raw_steps.reach[29] < _odometry.raw.FARTHEST[0]).all()


# --- The share of a place's walls that the beams of a scan would pass through ---------------------


OUTLINE = np.array([(-2.0, -2.5), (4.0, -2.5), (4.0, 1.5), (1.0, 1.5), (1.0, 3.0), (-2.0, 3.0)])
WALLS = np.stack([OUTLINE, np.roll(OUTLINE, -1, axis=0)], axis=1)
BEAMS = 360


def seen(pose, walls=WALLS, beams=BEAMS):
    """The points of a scan, in its own frame."""
    angles = np.linspace(-np.pi, np.pi, beams, endpoint=False)
    rays = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    ranges = ranges_of(np.asarray(pose, float), angles, walls)
    return Points(np.float32(ranges[:, None] * rays), np.float32(rays), np.ones(beams, bool))


@pytest.fixture(scope="module")
def through():
    program = jax.jit(_odometry.reference._share_seen_through)

    def of(scan, pose, reference=None):
        surface = seen((0.0, 0.0, 0.0)) if reference is None else reference
        return float(program(surface, scan, np.asarray(pose, np.float32)))

    return of


@pytest.mark.parametrize("pose", [(0, 0, 0), (0.7, -0.4, 2.0), (-1.2, 1.5, -3.0), (3.0, 1.0, 0.4)])
def test_nothing_from_where_the_scan_was_taken(through, pose):
    assert through(seen(pose), pose) < 0.02


@pytest.mark.parametrize("shift", [(0.1, 0.0, 0.0), (-0.1, 0.1, 0.03)])
def test_little_beside_it(through, shift):
    pose = np.array([0.5, 0.2, 1.0])
    assert through(seen(pose), poses.compose(pose, np.array(shift))) < 0.05


@pytest.mark.parametrize("pose", [(4.8, 0.2, 0.0), (0.5, -3.3, 0.0), (-2.8, 0.2, 0.0)])
def test_much_from_behind_a_wall(through, pose):
    """The wall stands 0.8 m off, before what the scan met there."""
    assert through(seen((0.5, 0.2, 0.0)), pose) > 0.2


def test_more_the_farther_a_pose_is_shifted_through_a_wall(through):
    scan = seen((0.0, 0.0, 0.0))
    shares = [through(scan, (x, 0.0, 0.0)) for x in (0.0, 1.0, 2.5)]
    assert shares[0] < 0.02 < shares[1] < shares[2]


def test_walls_behind_those_of_the_scan_are_not_in_view(through):
    """A box that was not there before hides what stands behind it, and is passed by none."""
    box = np.array([(1.0, -0.5), (1.5, -0.5), (1.5, 0.5), (1.0, 0.5)])
    more = np.concatenate([WALLS, np.stack([box, np.roll(box, -1, axis=0)], axis=1)])
    assert through(seen((0.0, 0.0, 0.0), more), (0.0, 0.0, 0.0)) == 0.0
    # The other way round: what the reference has there, the scan passes through.
    share = through(seen((0.0, 0.0, 0.0)), (0.0, 0.0, 0.0), seen((0.0, 0.0, 0.0), more))
    turn = 2 * np.arctan(0.5)  # as its front is seen
    assert share == pytest.approx(turn / (2 * np.pi), rel=0.2)


def test_beams_that_met_nothing_pass_through_nothing(through):
    scan = seen((0.0, 0.0, 0.0))
    none = scan._replace(valid=np.zeros(BEAMS, bool))
    assert through(none, (0.0, 0.0, 0.0)) == through(none, (6.0, 0.0, 0.0)) == 0.0
    # Points of the reference that are not valid count nothing.
    nothing = scan._replace(valid=np.zeros(BEAMS, bool))
    assert through(scan, (6.5, 0.0, 0.0), nothing) == 0.0
