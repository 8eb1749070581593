"""A map is counted window by window, as if all its scans were counted at once."""

import dataclasses

import numpy as np
import pytest
from ring_of_rooms import SETTINGS, driven

from jaxslam import grids
from jaxslam.core.types import Beams
from jaxslam.laser.laser_slam import ScanLog, mapping
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
    monkeypatch.setattr(mapping, "WINDOW", window)
    shape, origin, resolution = mapping.frame_of(log, [log.raw], settings)
    beams = mapping._used(log, settings, np.ones(len(log.time), bool), slice(None))
    laser = poses.compose(log.raw, np.array(log.mount))
    whole = grids.count(shape, origin, resolution, laser, beams, max_range=settings.max_range)
    calls = []
    count = grids.count

    def counting(size, *rest, **options):
        calls.append(size)
        return count(size, *rest, **options)

    monkeypatch.setattr(grids, "count", counting)
    found = np.zeros((2, *shape), np.int32)
    mapping._count(found, origin, resolution, laser, beams, settings)
    return found, np.stack([whole.hits, whole.misses]), calls


def test_scans_that_do_not_fit_a_window_are_split(monkeypatch):
    found, whole, windows = both(wandering(50, 40, 2.5), monkeypatch, 64)
    assert (
        len(windows) > 4
        and set(windows) == {(64, 64)}
        and whole[0].sum() > 500
        and max(whole.shape) > 64
    )
    np.testing.assert_array_equal(found, whole)


def test_so_are_long_logs_and_scans_of_many_beams(monkeypatch):
    found, whole, windows = both(wandering(150, 400, 1.5), monkeypatch, 512)
    assert len(windows) >= 6 and set(windows) == {(512, 512)}
    np.testing.assert_array_equal(found, whole)


@pytest.mark.parametrize(("far", "side"), [(2.5, 64), (5.0, 128), (9.0, 256)])
def test_a_scan_that_is_larger_than_a_window_has_a_larger_one(monkeypatch, far, side):
    log = wandering(3, 40, far)
    found, whole, windows = both(log, monkeypatch, 64)
    assert max(windows) == (side, side)
    assert mapping.frame_of(log, [log.raw], SETTINGS)[2] == RESOLUTION
    np.testing.assert_array_equal(found, whole)


def test_beams_along_the_axes_from_the_origin_are_counted_alike_in_every_window(monkeypatch):
    """Without care they lie on the borders of cells, and rounding decides."""
    _, log = driven()
    monkeypatch.setattr(mapping, "ROWS", 8)
    found, whole, windows = both(log, monkeypatch, 128)
    assert len(windows) == 5 and not log.raw[0].any()
    np.testing.assert_array_equal(found, whole)


def test_a_log_that_met_nothing_is_an_empty_map(monkeypatch):
    log = wandering(3, 40, 2.5)
    nothing = log._replace(beams=log.beams._replace(valid=np.zeros((3, 40), bool)))
    frame = mapping.frame_of(log, [log.raw], SETTINGS)
    grid = mapping.map_of(nothing, log.raw, np.ones(3, bool), frame, SETTINGS)
    assert not grid.log_odds.any()


@pytest.mark.parametrize("usable", [[True, False, True], [False, True, False]])
def test_scans_that_are_not_usable_say_nothing(usable):
    log, usable = wandering(3, 40, 2.5), np.array(usable)
    settings = dataclasses.replace(SETTINGS, resolution=2 * RESOLUTION)
    frame = mapping.frame_of(log, [log.raw], settings)
    some = log._replace(
        time=log.time[usable], raw=log.raw[usable], beams=Beams(*(b[usable] for b in log.beams))
    )
    every = np.ones(usable.sum(), bool)
    np.testing.assert_array_equal(
        mapping.map_of(log, log.raw, usable, frame, settings).log_odds,
        mapping.map_of(some, some.raw, every, frame, settings).log_odds,
    )
