"""Maps of logs: counted window by window, and by a laser that is not in the middle of its robot."""

import dataclasses

import numpy as np
import pytest
from cases import swept
from ring_of_rooms import SETTINGS, driven, errors, odometry_of, scans_of, steps_of, walls

from jaxslam import grids, laser_slam
from jaxslam.core.types import Beams
from jaxslam.laser.laser_slam import ScanLog, _log_map, _scan_points
from jaxslam.math import numpy_poses as poses

RESOLUTION = 0.1


def wandering(scans, beams, far, seed=0):
    """A log of scans at places tens of metres apart, and where they are."""
    random = np.random.default_rng(seed)
    step = np.column_stack(
        [random.uniform(0, 2, scans), np.zeros(scans), random.normal(size=scans)]
    )
    path = poses.chain(np.array([3.0, -2.0, 1.0]), step[1:])
    angles = np.broadcast_to(np.linspace(-2.0, 2.0, beams), (scans, beams))
    ranges = random.uniform(0.1, 1.1 * far, (scans, beams))
    valid = random.random((scans, beams)) < 0.9
    return ScanLog(np.arange(scans), Beams(ranges, angles, valid), path, far, (0.2, -0.1, 0.5))


def both(log, monkeypatch, window, settings=SETTINGS):
    """(hits, misses), counted in windows and at once; and the shapes of the windows."""
    monkeypatch.setattr(_log_map, "WINDOW", window)
    shape, origin, resolution = _log_map.frame_of(log, [log.raw], settings)
    beams = _log_map._used_beams(log, settings, np.ones(len(log.time), bool), slice(None))
    laser = poses.compose(log.raw, np.array(log.mount))
    at_once = grids.count(shape, origin, resolution, laser, beams, max_range=settings.max_range)
    calls = []
    count = grids.count

    def counting(size, *rest, **options):
        calls.append(size)
        return count(size, *rest, **options)

    monkeypatch.setattr(grids, "count", counting)
    counts = np.zeros((2, *shape), np.int32)
    _log_map._count(counts, origin, resolution, laser, beams, settings)
    return counts, np.stack([at_once.hits, at_once.misses]), calls


def test_scans_that_do_not_fit_a_window_are_split(monkeypatch):
    in_windows, at_once, windows = both(wandering(50, 40, 2.5), monkeypatch, 64)
    assert (
        len(windows) > 4
        and set(windows) == {(64, 64)}
        and at_once[0].sum() > 500
        and max(at_once.shape) > 64
    )
    np.testing.assert_array_equal(in_windows, at_once)


def test_so_are_long_logs_and_scans_of_many_beams(monkeypatch):
    in_windows, at_once, windows = both(wandering(150, 400, 1.5), monkeypatch, 512)
    assert len(windows) >= 6 and set(windows) == {(512, 512)}
    np.testing.assert_array_equal(in_windows, at_once)


@pytest.mark.parametrize(("far", "side"), [(2.5, 64), (5.0, 128), (9.0, 256)])
def test_a_scan_that_is_larger_than_a_window_has_a_larger_one(monkeypatch, far, side):
    log = wandering(3, 40, far)
    in_windows, at_once, windows = both(log, monkeypatch, 64)
    assert max(windows) == (side, side)
    assert _log_map.frame_of(log, [log.raw], SETTINGS)[2] == RESOLUTION
    np.testing.assert_array_equal(in_windows, at_once)


def test_beams_along_the_axes_from_the_origin_are_counted_alike_in_every_window(monkeypatch):
    """Without care they lie on the borders of cells, and rounding decides."""
    _, log = driven()
    monkeypatch.setattr(_log_map, "ROWS", 8)
    in_windows, at_once, windows = both(log, monkeypatch, 128)
    assert len(windows) == 5 and not log.raw[0].any()
    np.testing.assert_array_equal(in_windows, at_once)


def test_a_log_that_met_nothing_is_an_empty_map(monkeypatch):
    log = wandering(3, 40, 2.5)
    nothing = log._replace(beams=log.beams._replace(valid=np.zeros((3, 40), bool)))
    frame = _log_map.frame_of(log, [log.raw], SETTINGS)
    grid = _log_map.map_of(nothing, log.raw, np.ones(3, bool), frame, SETTINGS)
    assert not grid.log_odds.any()


@pytest.mark.parametrize("usable", [[True, False, True], [False, True, False]])
def test_scans_that_are_not_usable_say_nothing(usable):
    log, usable = wandering(3, 40, 2.5), np.array(usable)
    settings = dataclasses.replace(SETTINGS, resolution=2 * RESOLUTION)
    frame = _log_map.frame_of(log, [log.raw], settings)
    some = log._replace(
        time=log.time[usable], raw=log.raw[usable], beams=Beams(*(b[usable] for b in log.beams))
    )
    all_usable = np.ones(usable.sum(), bool)
    np.testing.assert_array_equal(
        _log_map.map_of(log, log.raw, usable, frame, settings).log_odds,
        _log_map.map_of(some, some.raw, all_usable, frame, settings).log_odds,
    )


# --- A laser that is not in the middle of its robot: path and map are as if it were ---------------


MOUNTS = [(0.3, -0.1, np.pi / 2), (0.0, 0.0, np.pi)]


def odometry(log, first):
    scans = scans_of(log)
    return odometry_of(scans, steps_of(log.raw, log.time), first)


def distance_from_walls(points):
    """(n,) of points (n, 2) from the nearest segment."""
    a, b = np.swapaxes(walls(), 0, 1)
    along = b - a
    share = np.einsum("nkd,kd->nk", points[:, None] - a, along) / (along**2).sum(axis=1)
    nearest = a + np.clip(share, 0, 1)[..., None] * along
    return np.linalg.norm(points[:, None] - nearest, axis=-1).min(axis=1)


@pytest.mark.parametrize("k", swept(range(2), 1))
def test_the_path_is_the_robots_and_the_map_is_of_the_walls(k):
    true, log = driven(mount=MOUNTS[k])
    solved = laser_slam.solve(log, SETTINGS)
    position, heading = errors(solved.poses, true)
    assert position.max() < 0.1 and heading.max() < np.deg2rad(1.5)
    score = laser_slam.closure_score(solved, true)
    assert score.kept >= 5 and score.precision == 1.0
    error = solved.poses[1:] - true[1:]
    error[:, 2] = poses.wrapped(error[:, 2])
    assert np.einsum("ki,kij,kj->k", error, np.linalg.inv(solved.cov[1:]), error).mean() < 9
    grid = solved.map
    occupied = np.argwhere(grid.log_odds > 0)[:, ::-1] * 0.1 + 0.05 + grid.origin[:2]
    assert len(occupied) > 100 and np.quantile(distance_from_walls(occupied), 0.95) < 0.15
    # A place on the way is free.
    column, row = ((true[20, :2] - grid.origin[:2]) / 0.1).astype(int)
    assert grid.log_odds[row, column] < 0
    # In a map that is drawn as if the laser were the robot's middle the walls are elsewhere.
    frame = grid.log_odds.shape, grid.origin, float(grid.resolution)
    usable = np.ones(len(true), bool)
    wrong = _log_map.map_of(
        log._replace(mount=(0.0, 0.0, 0.0)), solved.poses, usable, frame, SETTINGS
    )
    off = np.argwhere(wrong.log_odds > 0)[:, ::-1] * 0.1 + 0.05 + grid.origin[:2]
    assert np.quantile(distance_from_walls(off), 0.95) > 0.25


@pytest.mark.parametrize("k", swept(range(2), 1))
def test_without_its_mount_the_path_is_wrong(k):
    true, log = driven(mount=MOUNTS[k])
    right = errors(odometry(log, true[0]).poses, true)[0].max()
    wrong = errors(odometry(log._replace(mount=(0.0, 0.0, 0.0)), true[0]).poses, true)[0].max()
    assert right < 0.25 and wrong > 1.0


def test_points_are_in_the_robots_frame():
    """At the first pose, the origin, they lie on the walls."""
    _, log = driven(scans=2, mount=MOUNTS[0])
    scans = scans_of(log)
    valid = np.asarray(scans.points.valid)[0]
    points = np.asarray(scans.points.position, float)[0][valid]
    assert valid.sum() > 30 and distance_from_walls(points).max() < 0.06


@pytest.mark.parametrize(
    "mount", [(np.nan, 0.0, 0.0), (0.0, 0.0, np.inf), (0.1, 0.2), np.zeros((1, 3)), 0.0]
)
def test_a_mount_that_is_none_is_refused(mount):
    _, log = driven(scans=3)
    with pytest.raises(ValueError, match=r"mount: expected finite numbers of shape \(3,\), got"):
        _scan_points.laser_log(log._replace(mount=mount))


def test_a_mask_of_odometry_of_another_size_is_refused():
    _, log = driven(scans=3)
    _scan_points.laser_log(log._replace(odometry_known=np.ones(3, bool)))
    for mask in (np.ones(2, bool), np.ones((3, 1), bool), True):
        with pytest.raises(
            ValueError, match=r"odometry_known: expected shape \(3,\), as of the scans"
        ):
            _scan_points.laser_log(log._replace(odometry_known=mask))
