"""The map of a log's scans at given poses."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam import grids
from jaxslam.grids import Counts, Grid
from jaxslam.laser_slam.records import LogOfScans
from jaxslam.laser_slam.settings import Settings
from jaxslam.types import Beams

LARGEST = 4_000
"""cells along a side of the map; a larger world has larger cells"""
FILM = 400
"""cells along a side of a map in a film"""


def frame_of(
    log: LogOfScans, paths: list[Float[np.ndarray, "K 3"]], settings: Settings
) -> tuple[tuple[int, int], Float[np.ndarray, "3"], float]:
    """(shape, origin, resolution) of a map that holds the ends of all beams at all poses."""
    beams = _used(log, settings, np.ones(len(log.time), bool))
    hit = beams.valid & (beams.range < settings.max_range)
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for path in paths:
        turn = path[:, 2:3] + beams.angle
        ends = path[:, None, :2] + beams.range[..., None] * np.stack(
            [np.cos(turn), np.sin(turn)], axis=-1
        )
        every = np.concatenate([ends[hit], path[:, :2]])
        low, high = np.minimum(low, every.min(axis=0)), np.maximum(high, every.max(axis=0))
    resolution = max(settings.resolution, float((high - low).max()) / LARGEST)
    low = np.floor(low / resolution - 4) * resolution
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
    """The occupancy grid of usable scans; beams that met nothing say nothing."""
    shape, origin, resolution = frame
    beams = _used(log, settings, usable)
    if not (beams.valid & (beams.range > 0)).any():
        return Grid(np.zeros(shape), origin, np.asarray(resolution))
    counts = grids.count(shape, origin, resolution, path, beams, max_range=settings.max_range)
    found = grids.occupancy(counts)
    return Grid(*(np.asarray(part) for part in found))


def growing_maps(
    log: LogOfScans,
    path: Float[np.ndarray, "K 3"],
    settings: Settings,
    *,
    frames: int = 60,
    others: Sequence[Float[np.ndarray, "K 3"]] = (),
) -> tuple[list[Grid], Int[np.ndarray, "F"]]:
    """Maps of the first scans, more of them in each, for a film; and how many scans each has.

    Cells are as large as `FILM` of them along a side need.

    Args:
        frames: number of maps at most.
        others: paths whose maps have to fit the same frame.
    """
    paths = [path, *others]
    shape, _, resolution = frame_of(log, paths, settings)
    coarse = max(resolution, max(shape) * resolution / FILM)
    shape, origin, resolution = frame_of(log, paths, replace(settings, resolution=coarse))
    beams = _used(log, settings, np.ones(len(path), bool))
    together = -(-len(path) // min(frames, len(path)))
    hits, misses = np.zeros((2, *shape), np.int32)
    none = np.array(0)
    maps, until = [], []
    for begin in range(0, len(path), together):
        end = min(begin + together, len(path))
        fill = together - (end - begin)
        scans = Beams(*(np.pad(part[begin:end], [(0, fill), (0, 0)]) for part in beams))
        if scans.valid.any():
            poses = np.pad(path[begin:end], [(0, fill), (0, 0)])
            found = grids.count(
                shape, origin, resolution, poses, scans, max_range=settings.max_range
            )
            hits += np.asarray(found.hits)
            misses += np.asarray(found.misses)
        counts = Counts(hits, misses, origin, np.asarray(resolution), none, none)
        maps.append(Grid(*(np.asarray(part) for part in grids.occupancy(counts))))
        until.append(end)
    return maps, np.array(until)


def _used(log: LogOfScans, settings: Settings, usable: np.ndarray) -> Beams:
    ranges, angles, valid = (np.asarray(part) for part in log.beams)
    with np.errstate(invalid="ignore"):
        seen = (valid > 0) & (ranges > 0) & (ranges < log.max_range * (1 - 1e-6))
    seen &= usable[:, None]
    ranges = np.where(seen, np.minimum(ranges, settings.max_range), 0.0)
    return Beams(ranges, angles, seen)
