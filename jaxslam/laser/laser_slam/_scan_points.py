"""The scans of a log as points with the directions of their walls, and which scans are usable."""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxslam.core.types import Beams
from jaxslam.core.validation import InvalidField, finite, require
from jaxslam.laser.laser_slam._records import LogOfScans, Settings
from jaxslam.laser.matching import Points
from jaxslam.laser.matching._surfaces import Surface, surface

GAP = 0.5
"""[m] between points beyond which they are not of the same wall."""
SPAN = np.deg2rad(2.0)
"""Angle to either side of a point within which its neighbours lie."""
_MAX_NEIGHBOURS = 8
"""Neighbours to either side at most, for time: lines take a shift of the scan for each."""
WIDTH, ROWS = 384, 64
"""Beams and scans of one call that fits lines: logs are cut and filled up to these, so that all
share one program."""
_CHANGED, SHARE = 0.1, 0.2
"""A beam has changed if its range differs by this [m], a scan if this share of its beams has."""
_USUAL_SPACING = 0.02
"""[rad] between beams, if no two valid beams follow each other."""
_BACK = 8
"""Scans back with which a scan is compared: a slow robot changes little from one to the next."""


class Scans(NamedTuple):
    """K scans of at most B points, in the frame of the robot; float32, as matching computes."""

    points: Points
    """(K, B), the robot's place where not valid"""
    surface: Surface
    """(K, B) lines through the points and their neighbours"""
    usable: Bool[np.ndarray, "K"]
    """enough points to match"""
    changed: Int[np.ndarray, "K"]
    """number of scans back to the nearest of the last eight from which a scan differs; 0 if it
    differs from none, as of a robot at rest"""


def laser_log(value: LogOfScans) -> LogOfScans:
    """The check of a log of scans: shapes that fit each other, and finite numbers."""
    log = value
    shape = np.shape(log.beams.range)
    if len(shape) != 2 or 0 in shape:
        raise InvalidField("beams.range", f"expected (scans, beams), at least one, got {shape}")
    if np.shape(log.beams.angle) != shape or np.shape(log.beams.valid) != shape:
        raise InvalidField("beams", f"expected angles and masks {shape}, as the ranges have")
    for field, axes in (("raw", (3,)), ("time", ()), ("odometry_known", ())):
        part = getattr(log, field)
        got, expected = np.shape(part), (shape[0], *axes)
        if got != expected and not (field == "odometry_known" and part is None):
            raise InvalidField(field, f"expected shape {expected}, as of the scans, got {got}")
    require("mount", log.mount, finite(3))
    lost = np.asarray(log.beams.valid, bool) & ~np.isfinite(log.beams.angle)
    for field, noun, bad in (
        ("raw", "the odometry", ~np.isfinite(log.raw).all(axis=1)),
        ("time", "the time", ~np.isfinite(log.time)),
        ("beams.angle", "the angle of a valid beam", lost.any(axis=1)),
    ):
        if bad.any():
            raise InvalidField(field, f"{noun} of scan {int(bad.argmax())} is not finite")
    if not log.max_range > 0:
        raise InvalidField("max_range", f"expected a number above 0, got {log.max_range}")
    return log


def hits_of(beams: Beams, max_range: float) -> Beams:
    """The beams of scans, of which only those with a hit stay valid; others have range 0."""
    beams = Beams(*(np.asarray(part) for part in beams))
    met = np.asarray(beams.returns(max_range)[0])
    angles = np.where(beams.valid > 0, beams.angle, 0.0)
    return Beams(np.where(met, beams.range, 0.0), angles, met)


def scans_of(log: LogOfScans, settings: Settings) -> Scans:
    """The points of a log's scans in the robot's frame, and the lines through those within two
    degrees of each."""
    count, beams = np.shape(log.beams.range)
    stride = -(-beams // WIDTH)  # so that a scan fits the program
    # The spacing of the beams by some of the scans: `ROWS` at most.
    sampled = slice(None, None, -(-count // ROWS))
    angles = np.asarray(log.beams.angle)[sampled][:, ::stride]
    valid = (np.asarray(log.beams.valid)[sampled] > 0)[:, ::stride]
    between = np.abs(np.diff(angles, axis=1))[valid[:, 1:] & valid[:, :-1]]
    spacing = max(float(np.median(between)) if between.size else _USUAL_SPACING, 1e-3)
    span = np.int32(np.clip(round(SPAN / spacing), 2, _MAX_NEIGHBOURS))
    thinning = -(-len(range(0, beams, stride)) // settings.beams)
    changed = []
    scans: Any = None
    for begin in range(0, count, ROWS):  # a part at a time, since a log may be long
        last = max(begin - _BACK, 0)  # scans before this part, which its first scans compare with
        near = hits_of(
            Beams(*(np.asarray(part)[last : begin + ROWS] for part in log.beams)), log.max_range
        )
        since = _scans_since_change(np.asarray(near.range), np.asarray(near.valid))
        changed.append(since[begin - last :])
        # The ends of the beams that met something nearer than max_range, in the robot's frame.
        ranges, angles, met = (np.asarray(part)[begin - last :, ::stride] for part in near)
        met = met & (ranges < settings.max_range)
        x, y, heading = np.asarray(log.mount, float)
        rays = np.stack([np.cos(heading + angles), np.sin(heading + angles)], axis=-1)
        ends = np.where(met[..., None], [x, y] + ranges[..., None] * rays, 0.0)
        size, width = met.shape
        # Filled up to `ROWS` scans of `WIDTH` beams by points that are not valid.
        fill = [(0, ROWS - size), (0, WIDTH - width)]
        parts = ends.astype(np.float32), rays.astype(np.float32), met
        padded: Any = [np.pad(part, fill + [(0, 0)] * (part.ndim - 2)) for part in parts]
        filled = Points(*padded)
        lines = jax.tree.map(np.asarray, _surfaces(filled, span))
        # Beams that fill a scan up come last: they are cut off, or stay without a point.
        thinned = jax.tree.map(
            lambda part, n=size: _thin(part[:n], thinning, settings.beams), (filled, lines)
        )
        if not begin:  # allocated once: parts and their concatenation would take twice the memory
            scans = jax.tree.map(
                lambda part: np.empty((count, *part.shape[1:]), part.dtype), thinned
            )
        for table, part in zip(jax.tree.leaves(scans), jax.tree.leaves(thinned), strict=True):
            table[begin : begin + size] = part
    points, lines = scans
    usable = points.valid.sum(axis=1) >= settings.fewest
    return Scans(points, lines, usable, np.concatenate(changed))


def _thin(part: np.ndarray, stride: int, width: int) -> np.ndarray:
    """Each n-th of the beams, cut or filled up to a width."""
    beams = part[:, ::stride][:, :width]
    return np.pad(beams, [(0, 0), (0, width - beams.shape[1])] + [(0, 0)] * (part.ndim - 2))


@jax.jit
def _surfaces(points: Points, span: Int[Array, ""]) -> Surface:
    def surface_of(scan: Points) -> Surface:
        return surface(scan, span, GAP, most=_MAX_NEIGHBOURS)

    return jax.vmap(surface_of)(points)


def _scans_since_change(
    ranges: Float[np.ndarray, "K B"], met: Bool[np.ndarray, "K B"]
) -> Int[np.ndarray, "K"]:
    """The number of scans back to the last one that differs (`Scans.changed`); 1 for the first."""
    changed = np.zeros(len(ranges), int)
    # From the farthest to the nearest, so that the nearest that differs counts.
    for back in range(min(_BACK, len(ranges) - 1), 0, -1):
        differs = np.abs(ranges[back:] - ranges[:-back]) > _CHANGED
        differs |= met[back:] != met[:-back]
        either = met[back:] | met[:-back]
        share = (differs & either).sum(axis=1) / np.maximum(either.sum(axis=1), 1)
        changed[back:] = np.where(share > SHARE, back, changed[back:])
    changed[0] = 1
    return changed
