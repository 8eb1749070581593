"""A room for `verify`, whose map is smooth near its walls, and poses and ranges in it.

Four slanted walls, near which the share of a cell that is solid falls off linearly, over cells:
there bilinear interpolation has no error, so that a right derivative and differences of the values
agree. Close to kinks, as the lines between cells, differences take smaller steps.
"""

import functools

import numpy as np
from jaxtyping import Float

from jaxslam.laser.grids._grid import Grid

ANGLES = np.array([-2.7, -1.9, -1.1, -0.3, 0.5, 1.3, 2.1, 2.9])
_CELL, _ORIGIN = 0.5, (-17.03, -14.11, 0.2)
_WIDTH = 6.0
"""Width [m] of the strip at a wall over which the solid share rises from 0 to 1."""
_HEADINGS = (0.0, 1e-9, -1e-9, np.pi, np.pi - 1e-9, 1e-9 - np.pi, np.pi / 2)
_CORNER = 2.0
"""Least distance of a trial beam's end from a corner [m], and from another wall's line."""


@functools.cache
def smooth_map() -> Grid:
    """The map of the room."""
    height, width = 64, 70
    x, y = np.meshgrid(_CELL * (np.arange(width) + 0.5), _CELL * (np.arange(height) + 0.5))
    c, s = np.cos(_ORIGIN[2]), np.sin(_ORIGIN[2])
    points = np.stack([_ORIGIN[0] + c * x - s * y, _ORIGIN[1] + s * x + c * y], axis=-1)
    beyond = np.max(points @ _NORMALS.T - _OFFSETS, axis=-1)
    solid = np.clip(0.5 + beyond / _WIDTH, 0.01, 0.99)
    return Grid(np.log(solid / (1 - solid)), np.array(_ORIGIN), np.float64(_CELL))  # type: ignore[arg-type]


_TURNS = np.array([0.31, 1.93, 3.52, 5.0])
_NORMALS = np.stack([np.cos(_TURNS), np.sin(_TURNS)], axis=1)
"""(4, 2) outward normals of the walls; a point is inside where n·p < offset for all."""
_OFFSETS = np.array([9.0, 8.0, 8.5, 7.5])


def poses_and_ranges(
    mount: Float[np.ndarray, "3"], count: int, seed: int
) -> tuple[tuple[np.ndarray, np.ndarray], tuple[str, ...]]:
    """Poses in the room with ranges beside the true ones, and labels.

    The first have random headings, others difficult ones. mount: of the laser on the robot.
    """
    rng = np.random.default_rng(seed)
    headings = np.concatenate([rng.uniform(-np.pi, np.pi, count), _HEADINGS])
    labels = ("random",) * count + tuple(f"pose theta = {h:.4g}" for h in _HEADINGS)
    poses = []
    for heading in headings:
        pose = np.array([*rng.uniform(-3, 3, 2), heading])
        while not _ranges(pose[None], mount)[1].min() > _CORNER:  # a beam ends near a corner
            pose = np.array([*rng.uniform(-3, 3, 2), heading])
        poses.append(pose)
    pose = np.array(poses)
    ranges = _ranges(pose, mount)[0] + 0.15 * rng.normal(size=(len(pose), len(ANGLES)))
    return (pose, ranges), labels


def _ranges(
    pose: Float[np.ndarray, "S 3"], mount: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "S B"], Float[np.ndarray, "S B"]]:
    """The exact range of each beam, and the distance of its end from the next wall's line."""
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    arm = np.stack([c * mount[0] - s * mount[1], s * mount[0] + c * mount[1]], axis=1)
    eye = (pose[:, :2] + arm)[:, None]
    heading = pose[:, 2, None] + mount[2] + ANGLES
    e = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    towards = e @ _NORMALS.T
    room = (_OFFSETS - eye @ _NORMALS.T) / np.where(towards > 1e-9, towards, np.nan)
    ranges = np.nanmin(room, axis=-1)
    ends = eye + ranges[..., None] * e
    gaps = np.sort(_OFFSETS - ends @ _NORMALS.T, axis=-1)
    return ranges, gaps[..., 1]
