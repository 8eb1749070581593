"""Laser odometry where raw odometry lies for a moment, or says nothing, against the true path."""

import dataclasses

import jax
import numpy as np
import pytest
from ring_of_rooms import SETTINGS, driven, errors

from jaxslam import laser_slam
from jaxslam.laser.laser_slam.odometry import pieces, tracking
from jaxslam.laser.laser_slam.odometry.pieces import laser_odometry
from jaxslam.laser.laser_slam.odometry.raw import steps_of
from jaxslam.laser.laser_slam.scans import scans_of
from jaxslam.math import numpy_poses as poses

COUNT = 40
CORNERS = [6, 12, 18, 24, 30, 36]
"""Scans to which the robot drove a metre and turned by 90°."""


@pytest.fixture(scope="module")
def drive():
    """(true path, log, its scans)"""
    true, log = driven(COUNT)
    return true, log, scans_of(log, SETTINGS)


def solved(drive, raw=None, scans=None, known=None):
    """The steps, and the odometry from the true first pose on."""
    true, log, every = drive
    scans = every if scans is None else scans
    steps = steps_of(log.raw if raw is None else raw, SETTINGS, log.time, scans.changed, known)
    return steps, laser_odometry(scans, steps, SETTINGS, true[0])


def nees(found, true, k):
    """Of a scan in the frame of the keyframe before it."""
    off = relative_error(found, true, k)
    return off @ np.linalg.solve(found.cov[k], off)


def relative_error(found, true, k):
    return poses.between(poses.between(true[found.base[k]], true[k]), found.z[k])


def late(raw, k, share=0.05):
    """The message at scan k says a part of the step, the one after it says all."""
    raw = np.array(raw)
    raw[k] = poses.compose(raw[k - 1], share * poses.between(raw[k - 1], raw[k]))
    return raw


def check_late(drive, k, share):
    true, log, _ = drive
    steps, found = solved(drive, late(log.raw, k, share))
    position, heading = errors(found.poses, true)
    others = np.arange(COUNT) != k
    # Without loops the path drifts by a tenth of a metre, whatever a single step does.
    assert position[others].max() < 0.2 and heading[others].max() < np.deg2rad(5), k
    assert nees(found, true, k) < 20
    assert position[k] < 0.3 or not found.matched[k]
    return steps


def test_a_log_in_pieces_has_the_path_of_one(drive, monkeypatch):
    true, _, _ = drive
    _, whole = solved(drive)
    monkeypatch.setattr(pieces, "PIECE", 13)
    _, found = solved(drive)
    inner = sorted({13, 26} & set(found.keyframe.tolist()))
    assert inner == [13, 26], "the first scan of a piece is a keyframe"
    assert (found.base[1:] < np.arange(1, COUNT)).all() and found.matched[1:].all()
    for path in (whole.poses, found.poses):
        position, heading = errors(path, true)
        assert position.max() < 0.2 and heading.max() < np.deg2rad(5)
    chained = poses.compose(found.poses[found.base[1:]], found.z[1:])
    np.testing.assert_allclose(chained, found.poses[1:], atol=1e-9)


def test_an_interrupt_ends_all_pieces(drive, monkeypatch):
    _, log, scans = drive
    monkeypatch.setattr(pieces, "PIECE", 10)
    steps, calls = steps_of(log.raw, SETTINGS), []

    def progress(done, of):
        calls.append(done)
        if len(calls) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        laser_odometry(scans, steps, SETTINGS, log.raw[0], progress)
    assert len(calls) < 10


@pytest.mark.parametrize("k", [3, 10, 21, 29, 38])
def test_a_message_that_comes_late_moves_no_scan(drive, k):
    steps = check_late(drive, k, 0.05)
    np.testing.assert_array_equal(np.flatnonzero(steps.lags), [k])


@pytest.mark.parametrize("k", [3, 10, 21, 29, 38])
def test_a_message_that_is_missing_and_comes_with_the_next_moves_no_scan(drive, k):
    """Odometry repeats a pose while the scan changes, and makes up for it: it is not lost."""
    steps = check_late(drive, k, 0.0)
    np.testing.assert_array_equal(np.flatnonzero(steps.frozen), [k])


@pytest.mark.parametrize("share", [0.05, 0.0])
@pytest.mark.parametrize("k", CORNERS)
def test_a_turn_that_comes_late_bends_nothing(drive, k, share):
    """By its speed it cannot be told: the robot turns as fast at every corner."""
    check_late(drive, k, share)


@pytest.mark.parametrize("k", [3, 15, 27])
@pytest.mark.parametrize("wrong", [(1.8, 0.0, 0.0), (0.0, 1.5, 0.0), (0.0, 0.0, 1.2)])
def test_a_single_wrong_pose_of_raw_odometry_moves_no_other_scan(drive, k, wrong):
    """The scan itself may match a place that looks alike, in doubt."""
    true, log, _ = drive
    raw = log.raw.copy()
    raw[k] = poses.compose(raw[k], np.array(wrong))
    _, found = solved(drive, raw)
    position, _ = errors(found.poses, true)
    assert np.delete(position, k).max() < 0.2
    assert position[k] < 0.2 or found.doubted[k]
    assert nees(found, true, k) < 20


@pytest.mark.parametrize("first", [4, 15, 23, 33])
def test_odometry_that_is_frozen_for_some_steps_is_found_by_the_scans(drive, first):
    """What the robot drove meanwhile is lost to raw odometry for good."""
    true, log, _ = drive
    step = poses.between(log.raw[:-1], log.raw[1:])
    step[first - 1 : first + 3] = 0.0
    at = np.arange(first, first + 4)
    known = ~np.isin(np.arange(COUNT), at)
    steps, found = solved(drive, poses.chain(true[0], step), known=known)
    np.testing.assert_array_equal(steps.frozen, ~known)
    assert found.matched[at].all()
    assert errors(found.poses, true)[0].max() < 0.2
    assert max(nees(found, true, k) for k in at) < 30


def test_odometry_that_is_frozen_on_the_whole_drive(drive):
    """Steps of a metre; at a corner the step before is no guess, and the place looks alike if it is
    turned by 90°, so that there a match may be wrong."""
    true, log, _ = drive
    raw, known = np.zeros((COUNT, 3)), np.arange(COUNT) == 0
    steps, found = solved(drive, raw, known=known)
    assert steps.frozen[1:].all() and not steps.jump.any()
    off = np.array([relative_error(found, true, k) for k in range(1, COUNT)])
    right = (np.hypot(off[:, 0], off[:, 1]) < 0.2) & (np.abs(off[:, 2]) < np.deg2rad(6))
    turns = np.isin(np.arange(1, COUNT), [*CORNERS, *(k + 1 for k in CORNERS)])
    assert right[~turns].mean() > 0.9
    assert right.mean() > 0.75
    assert found.doubted[1:].sum() >= 4 and (found.cov[1:].diagonal(axis1=1, axis2=2) > 0).all()


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


@pytest.mark.parametrize("k", [2, 14, 22, 30])
def test_a_scan_without_points_stays_where_raw_odometry_leads(drive, k):
    true, log, every = drive
    scans = jax.tree.map(np.array, every)
    scans.points.valid[k], scans.usable[k] = False, False
    _, found = solved(drive, scans=scans)
    assert not found.matched[k] and k not in found.keyframe
    step = poses.between(log.raw[k - 1], log.raw[k])
    np.testing.assert_allclose(found.poses[k], poses.compose(found.poses[k - 1], step), atol=1e-9)
    assert np.delete(found.matched[1:], k - 1).all()
    assert np.delete(errors(found.poses, true)[0], k).max() < 0.2
    assert nees(found, true, k) < 20


@pytest.mark.parametrize("k", [5, 16, 25])
def test_a_scan_that_matches_nothing_before_is_placed_by_what_comes_after(drive, monkeypatch, k):
    """Raw odometry is wrong at it alone. The others are as if it had no points."""
    true, log, every = drive
    raw = log.raw.copy()
    raw[k] = poses.compose(raw[k], np.array([-0.4, 0.5, 0.3]))
    refused = np.asarray(every.points.position)[k]
    match = tracking._matched

    def refusing(reference, points, *rest):
        found = match(reference, points, *rest)
        same = np.array_equal(points.position, refused)
        return found._replace(accepted=found.accepted and not same)

    monkeypatch.setattr(tracking, "_matched", refusing)
    _, found = solved(drive, raw)
    assert k not in found.keyframe and found.matched[k]
    assert np.linalg.norm(poses.between(raw[k - 1], raw[k]) - [1.0, 0.0, 0.0]) > 0.4
    assert errors(found.poses, true)[0].max() < 0.2
    assert np.hypot(*relative_error(found, true, k)[:2]) < 0.1
    assert nees(found, true, k) < 20
    # With nothing but the scans before it, it stays where raw odometry leads.
    monkeypatch.setattr(pieces, "place_unmatched", lambda *_: None)
    _, alone = solved(drive, raw)
    assert k not in alone.keyframe and not alone.matched[k]
    others = np.arange(COUNT) != k
    np.testing.assert_array_equal(alone.poses[others], found.poses[others])
    step = poses.between(raw[k - 1], raw[k])
    np.testing.assert_allclose(alone.poses[k], poses.compose(found.poses[k - 1], step), atol=1e-9)
