"""The map of a log's scans at given poses."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam.core.types import Beams
from jaxslam.laser import grids
from jaxslam.laser.grids import Counts, Grid
from jaxslam.laser.laser_slam._records import LogOfScans, Settings
from jaxslam.laser.laser_slam._scan_points import ROWS, WIDTH, met_something
from jaxslam.math import numpy_poses as poses

_MAX_CELLS = 4_000
"""cells along a side of the map; a larger world has larger cells"""
_FILM_CELLS = 400
"""cells along a side of a map in a film"""
WINDOW = 1024
"""Cells along a side of the window in which scans are counted: one program for all maps, but for
scans that are larger."""
_CORNER_OFFSET = np.array([0.37, 0.29])
"""Cells from the origin of `raw` to a corner of a cell: a robot that starts there, or drives along
an axis, has no beams along the borders of cells, where rounding decides what they cross."""


def frame_of(
    log: LogOfScans, paths: list[Float[np.ndarray, "K 3"]], settings: Settings
) -> tuple[tuple[int, int], Float[np.ndarray, "3"], float]:
    """(shape, origin, resolution) of a map that holds the ends of all beams at all poses."""
    every = np.ones(len(log.time), bool)
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for path in paths:
        laser = poses.compose(path, np.asarray(log.mount, float))
        for begin in range(0, len(laser), ROWS):
            rows = slice(begin, begin + ROWS)
            first, last = _boxes(laser[rows], _used(log, settings, every, rows))
            low, high = np.minimum(low, first.min(axis=0)), np.maximum(high, last.max(axis=0))
    resolution = max(settings.resolution, float((high - low).max()) / _MAX_CELLS)
    low = (np.floor(low / resolution - 4) + _CORNER_OFFSET) * resolution
    width, height = (int(n) for n in np.ceil((high - low) / resolution) + 4)
    # Whole pieces of 64 cells: maps of nearly the same size share a program.
    return (-(-height // 64) * 64, -(-width // 64) * 64), np.array([*low, 0.0]), resolution


def map_of(
    log: LogOfScans,
    path: Float[np.ndarray, "K 3"],
    usable: Bool[np.ndarray, "K"],
    frame: tuple[tuple[int, int], Float[np.ndarray, "3"], float],
    settings: Settings,
) -> Grid:
    """The occupancy grid of usable scans; beams that met nothing have no effect."""
    shape, origin, resolution = frame
    counts = np.zeros((2, *shape), np.int32)
    laser = poses.compose(path, np.asarray(log.mount, float))
    for begin in range(0, len(path), ROWS):
        rows = slice(begin, begin + ROWS)
        beams = _used(log, settings, usable, rows)
        _count(counts, origin, resolution, laser[rows], beams, settings)
    return _occupancy(counts, origin, resolution)


def _count(
    counts: Int[np.ndarray, "2 H W"],
    origin: Float[np.ndarray, "3"],
    resolution: float,
    laser: Float[np.ndarray, "n 3"],
    beams: Beams,
    settings: Settings,
) -> None:
    """Add the hits and misses of n scans to those of a map, in place.

    Some scans at a time in a window of fixed size, some beams at a time, so that all logs and maps
    share one program. The window lies where these scans are; if they do not fit, half of them may,
    and for a single one it is larger.
    """
    width = beams.range.shape[1]
    if width > WIDTH:  # the further beams as further scans
        for begin in range(0, width, WIDTH):
            part = Beams(*(each[:, begin : begin + WIDTH] for each in beams))
            _count(counts, origin, resolution, laser, part, settings)
        return
    if len(laser) > ROWS:
        for begin in range(0, len(laser), ROWS):
            rows = slice(begin, begin + ROWS)
            part = Beams(*(each[rows] for each in beams))
            _count(counts, origin, resolution, laser[rows], part, settings)
        return
    corner, ends = _boxes(laser, beams)
    first = np.floor((corner.min(axis=0) - origin[:2]) / resolution).astype(int) - 1
    size = np.ceil((ends.max(axis=0) - origin[:2]) / resolution).astype(int) + 2 - first
    if (size > WINDOW).any() and len(laser) > 1:
        half = len(laser) // 2
        for rows in (slice(half), slice(half, None)):
            part = Beams(*(each[rows] for each in beams))
            _count(counts, origin, resolution, laser[rows], part, settings)
        return
    if not beams.valid.any():
        return
    window = max(WINDOW, 1 << int(size.max() - 1).bit_length())
    fill = [(0, ROWS - len(laser)), (0, WIDTH - width)]
    found = grids.count(
        (window, window),
        np.array([*(origin[:2] + first * resolution), 0.0]),
        resolution,
        np.pad(laser, [fill[0], (0, 0)]),
        Beams(*(np.pad(each, fill) for each in beams)),
        max_range=settings.max_range,
    )
    height, width = counts.shape[1:]
    low, high = np.maximum(first, 0), np.minimum(first + size, [width, height])
    in_total = (slice(low[1], high[1]), slice(low[0], high[0]))
    in_part = tuple(
        slice(s.start - f, s.stop - f) for s, f in zip(in_total, first[::-1], strict=True)
    )
    for total, counted in zip(counts, (found.hits, found.misses), strict=True):
        total[in_total] += np.asarray(counted)[in_part]


def _occupancy(
    counts: Int[np.ndarray, "2 H W"], origin: Float[np.ndarray, "3"], resolution: float
) -> Grid:
    """The log-odds of `grids.occupancy`, which are linear in the counts, on the host."""
    one = Counts(np.eye(2)[:1], np.eye(2)[1:], origin, np.asarray(resolution), *np.zeros((2, 1)))
    hit, miss = np.asarray(grids.occupancy(one).log_odds)[0]
    return Grid(counts[0] * hit + counts[1] * miss, origin, np.asarray(resolution))


def _boxes(laser: Float[np.ndarray, "n 3"], beams: Beams) -> tuple[np.ndarray, np.ndarray]:
    """(n, 2) the lowest and the highest x and y of the ends of each scan's beams and its laser."""
    turn = laser[:, 2:3] + beams.angle
    ray = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    reach = np.where(np.asarray(beams.valid), beams.range, 0.0)
    ends = laser[:, None, :2] + reach[..., None] * ray
    return ends.min(axis=1, initial=np.inf), ends.max(axis=1, initial=-np.inf)


def growing_maps(
    log: LogOfScans,
    path: Float[np.ndarray, "K 3"],
    settings: Settings,
    *,
    frames: int = 60,
    others: Sequence[Float[np.ndarray, "K 3"]] = (),
) -> tuple[list[Grid], Int[np.ndarray, "F"]]:
    """Maps of the first scans, more of them in each, for a film; and how many scans each has.

    Cells are as large as `_FILM_CELLS` of them along a side need.

    Args:
        frames: number of maps at most.
        others: paths whose maps have to fit the same frame.
    """
    paths = [path, *others]
    shape, _, resolution = frame_of(log, paths, settings)
    coarse = max(resolution, max(shape) * resolution / _FILM_CELLS)
    shape, origin, resolution = frame_of(log, paths, replace(settings, resolution=coarse))
    laser = poses.compose(path, np.asarray(log.mount, float))
    together = -(-len(path) // min(frames, len(path)))
    counts = np.zeros((2, *shape), np.int32)
    maps, until = [], []
    for begin in range(0, len(path), together):
        rows = slice(begin, begin + together)
        beams = _used(log, settings, np.ones(len(path), bool), rows)
        _count(counts, origin, resolution, laser[rows], beams, settings)
        maps.append(_occupancy(counts, origin, resolution))
        until.append(min(begin + together, len(path)))
    return maps, np.array(until)


def _used(log: LogOfScans, settings: Settings, usable: np.ndarray, rows: slice) -> Beams:
    """The beams of some scans for a map; beams of scans that are not usable met nothing."""
    some = Beams(*(np.asarray(part)[rows] for part in log.beams))
    ranges, angles, met = (np.asarray(part) for part in met_something(some, log.max_range))
    seen = met & usable[rows, None]
    ranges = np.where(seen, np.minimum(ranges, settings.max_range), 0.0)
    return Beams(ranges, angles, seen)
