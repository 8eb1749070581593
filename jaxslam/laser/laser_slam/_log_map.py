"""The map of a log's scans at given poses."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam.core.types import Beams
from jaxslam.laser import grids
from jaxslam.laser.grids import Counts, Grid
from jaxslam.laser.laser_slam._records import LogOfScans, Settings
from jaxslam.laser.laser_slam._scan_points import ROWS, WIDTH, hits_of
from jaxslam.math import numpy_poses as poses

_MAX_CELLS = 4_000
"""Cells along a side of the map, at most; a larger world has larger cells."""
_FILM_CELLS = 400
"""Cells along a side of a map in a film, at most."""
_BORDER = 4
"""Cells of border around the ends of all beams."""
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
    all_scans = np.ones(len(log.time), bool)
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for path in paths:
        laser = poses.compose(path, np.asarray(log.mount, float))
        for begin in range(0, len(laser), ROWS):
            rows = slice(begin, begin + ROWS)
            first, last = _boxes(laser[rows], _used_beams(log, settings, all_scans, rows))
            low, high = np.minimum(low, first.min(axis=0)), np.maximum(high, last.max(axis=0))
    resolution = max(settings.resolution, float((high - low).max()) / _MAX_CELLS)
    low = (np.floor(low / resolution - _BORDER) + _CORNER_OFFSET) * resolution
    width, height = (int(n) for n in np.ceil((high - low) / resolution) + _BORDER)
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
        beams = _used_beams(log, settings, usable, rows)
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

    All logs and maps share a program: up to `ROWS` scans of `WIDTH` beams, in a window of `WINDOW`
    cells. Larger parts are divided:

    | case | counted |
    |---|---|
    | more beams | `WIDTH` beams at a time |
    | more scans | `ROWS` scans at a time |
    | scans that do not fit into the window | half of them at a time |
    | a scan that does not fit | in a larger window, of a power of two |
    """
    width = beams.range.shape[1]
    if width > WIDTH:
        for begin in range(0, width, WIDTH):
            part = Beams(*(column[:, begin : begin + WIDTH] for column in beams))
            _count(counts, origin, resolution, laser, part, settings)
        return
    if len(laser) > ROWS:
        for begin in range(0, len(laser), ROWS):
            rows = slice(begin, begin + ROWS)
            part = Beams(*(column[rows] for column in beams))
            _count(counts, origin, resolution, laser[rows], part, settings)
        return
    corner, ends = _boxes(laser, beams)
    first = np.floor((corner.min(axis=0) - origin[:2]) / resolution).astype(int) - 1
    size = np.ceil((ends.max(axis=0) - origin[:2]) / resolution).astype(int) + 2 - first
    if (size > WINDOW).any() and len(laser) > 1:
        half = len(laser) // 2
        for rows in (slice(half), slice(half, None)):
            part = Beams(*(column[rows] for column in beams))
            _count(counts, origin, resolution, laser[rows], part, settings)
        return
    if not beams.valid.any():
        return
    window = max(WINDOW, 1 << int(size.max() - 1).bit_length())
    fill = [(0, ROWS - len(laser)), (0, WIDTH - width)]
    window_counts = grids.count(
        (window, window),
        np.array([*(origin[:2] + first * resolution), 0.0]),
        resolution,
        np.pad(laser, [fill[0], (0, 0)]),
        Beams(*(np.pad(column, fill) for column in beams)),
        max_range=settings.max_range,
    )
    height, width = counts.shape[1:]
    low, high = np.maximum(first, 0), np.minimum(first + size, [width, height])
    # (rows, columns) of the part of the window that lies on the map, in the map and in the window.
    in_map = (slice(low[1], high[1]), slice(low[0], high[0]))
    in_window = tuple(
        slice(s.start - f, s.stop - f) for s, f in zip(in_map, first[::-1], strict=True)
    )
    for total, added in zip(counts, (window_counts.hits, window_counts.misses), strict=True):
        total[in_map] += np.asarray(added)[in_window]


def _occupancy(
    counts: Int[np.ndarray, "2 H W"], origin: Float[np.ndarray, "3"], resolution: float
) -> Grid:
    """The log-odds of `grids.occupancy`, which are linear in the counts, on the host."""
    # A map of two cells: the first was hit once, the second missed once.
    single = Counts(np.eye(2)[:1], np.eye(2)[1:], origin, np.asarray(resolution), *np.zeros((2, 1)))
    hit, miss = np.asarray(grids.occupancy(single).log_odds)[0]
    return Grid(counts[0] * hit + counts[1] * miss, origin, np.asarray(resolution))


def _boxes(laser: Float[np.ndarray, "n 3"], beams: Beams) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and the highest x and y (n, 2) of the laser and the ends of the beams of scans."""
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
    """Maps of the first scans of a log, growing in number, for a film; and the numbers of scans.

    Cells are so large that a side has at most `_FILM_CELLS`.

    Args:
        frames: number of maps, at most.
        others: further paths whose maps have to fit the same frame.
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
        beams = _used_beams(log, settings, np.ones(len(path), bool), rows)
        _count(counts, origin, resolution, laser[rows], beams, settings)
        maps.append(_occupancy(counts, origin, resolution))
        until.append(min(begin + together, len(path)))
    return maps, np.array(until)


def _used_beams(log: LogOfScans, settings: Settings, usable: np.ndarray, rows: slice) -> Beams:
    """The beams of a slice of scans for a map; beams of unusable scans are without a hit."""
    beams = Beams(*(np.asarray(part)[rows] for part in log.beams))
    ranges, angles, met = (np.asarray(part) for part in hits_of(beams, log.max_range))
    seen = met & usable[rows, None]
    ranges = np.where(seen, np.minimum(ranges, settings.max_range), 0.0)
    return Beams(ranges, angles, seen)
