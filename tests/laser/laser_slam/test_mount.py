"""A laser that is not in the middle of its robot: path and map are as if it were."""

import numpy as np
import pytest
from ring_of_rooms import SETTINGS, driven, errors, walls

from jaxslam import laser_slam
from jaxslam.laser.laser_slam.mapping import map_of
from jaxslam.laser.laser_slam.odometry.pieces import laser_odometry
from jaxslam.laser.laser_slam.odometry.raw import steps_of
from jaxslam.laser.laser_slam.scans import check_laser_log, scans_of
from jaxslam.math import numpy_poses as poses

MOUNTS = [(0.3, -0.1, np.pi / 2), (0.0, 0.0, np.pi)]


def odometry(log, first):
    scans = scans_of(log, SETTINGS)
    return laser_odometry(scans, steps_of(log.raw, SETTINGS, log.time), SETTINGS, first)


def distance_from_walls(points):
    """(n,) of points (n, 2) from the nearest segment."""
    a, b = np.swapaxes(walls(), 0, 1)
    along = b - a
    share = np.einsum("nkd,kd->nk", points[:, None] - a, along) / (along**2).sum(axis=1)
    nearest = a + np.clip(share, 0, 1)[..., None] * along
    return np.linalg.norm(points[:, None] - nearest, axis=-1).min(axis=1)


@pytest.mark.parametrize("mount", MOUNTS)
def test_the_path_is_the_robots_and_the_map_is_of_the_walls(mount):
    true, log = driven(mount=mount)
    found = laser_slam.solve(log, SETTINGS)
    position, heading = errors(found.poses, true)
    assert position.max() < 0.1 and heading.max() < np.deg2rad(1.5)
    score = laser_slam.closure_score(found, true)
    assert score.kept >= 5 and score.precision == 1.0
    error = found.poses[1:] - true[1:]
    error[:, 2] = poses.wrapped(error[:, 2])
    assert np.einsum("ki,kij,kj->k", error, np.linalg.inv(found.cov[1:]), error).mean() < 9
    grid = found.map
    occupied = np.argwhere(grid.log_odds > 0)[:, ::-1] * 0.1 + 0.05 + grid.origin[:2]
    assert len(occupied) > 100 and np.quantile(distance_from_walls(occupied), 0.95) < 0.15
    # A place on the way is free.
    column, row = ((true[20, :2] - grid.origin[:2]) / 0.1).astype(int)
    assert grid.log_odds[row, column] < 0
    # In a map that is drawn as if the laser were the robot's middle the walls are elsewhere.
    frame = grid.log_odds.shape, grid.origin, float(grid.resolution)
    usable = np.ones(len(true), bool)
    wrong = map_of(log._replace(mount=(0.0, 0.0, 0.0)), found.poses, usable, frame, SETTINGS)
    off = np.argwhere(wrong.log_odds > 0)[:, ::-1] * 0.1 + 0.05 + grid.origin[:2]
    assert np.quantile(distance_from_walls(off), 0.95) > 0.25


@pytest.mark.parametrize("mount", MOUNTS)
def test_without_its_mount_the_path_is_wrong(mount):
    true, log = driven(mount=mount)
    right = errors(odometry(log, true[0]).poses, true)[0].max()
    wrong = errors(odometry(log._replace(mount=(0.0, 0.0, 0.0)), true[0]).poses, true)[0].max()
    assert right < 0.25 and wrong > 1.0


def test_points_are_in_the_robots_frame():
    """At the first pose, the origin, they lie on the walls."""
    _, log = driven(scans=2, mount=MOUNTS[0])
    scans = scans_of(log, SETTINGS)
    valid = np.asarray(scans.points.valid)[0]
    points = np.asarray(scans.points.position, float)[0][valid]
    assert valid.sum() > 30 and distance_from_walls(points).max() < 0.06


@pytest.mark.parametrize(
    "mount", [(np.nan, 0.0, 0.0), (0.0, 0.0, np.inf), (0.1, 0.2), np.zeros((1, 3)), 0.0]
)
def test_a_mount_that_is_none_is_refused(mount):
    _, log = driven(scans=3)
    with pytest.raises(ValueError, match="here: expected a mount of three finite numbers, got"):
        check_laser_log("here", log._replace(mount=mount))


def test_a_mask_of_odometry_of_another_size_is_refused():
    _, log = driven(scans=3)
    check_laser_log("here", log._replace(odometry_known=np.ones(3, bool)))
    for known in (np.ones(2, bool), np.ones((3, 1), bool), True):
        with pytest.raises(ValueError, match="here: expected odometry_known of each of 3 scans"):
            check_laser_log("here", log._replace(odometry_known=known))
