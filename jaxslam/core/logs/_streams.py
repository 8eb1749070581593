"""Asynchronous streams of odometry and measurements as the rows of a log; NumPy in, NumPy out.

A row is a time: the control that leads to it from the row before, and the scan at it. `align` makes
rows of two streams with times of their own; the rules say what control a stream of odometry gives.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from jaxslam.math._odometry_jumps import lost_lines, odometry_jumps
from jaxslam.math.numpy_poses import between, compose, part

Rule = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""(times (K,), odometry (K, V), rows (T,)) -> control (T, U) that leads to each row"""


Interpolation = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""(times (K,), poses (K, 3), rows (T,)) -> pose at each row (T, 3)"""


class Rows(NamedTuple):
    """T rows, with scans padded to M measurement slots: the fields of a log as NumPy arrays."""

    time: Float[np.ndarray, "T"]
    control: Float[np.ndarray, "T U"]
    z: Float[np.ndarray, "T M Z"]
    tag: Int[np.ndarray, "T M"]
    valid: Bool[np.ndarray, "T M"]


def align_streams(
    odometry: tuple[ArrayLike, ArrayLike],
    measurements: tuple[ArrayLike, ArrayLike, ArrayLike],
    rule: Rule,
    rows: ArrayLike | None = None,
) -> Rows:
    """The rows of a stream of odometry and a stream of measurements.

    Scans keep the order of the measurements. They are padded to the largest one with z 0, tag -1.

    Args:
        odometry: times (K,), and values (K, V).
        measurements: times (J,) in any order, tags (J,), and values (J, Z). Those of one time are a
            scan.
        rule: `hold`, `divide`, `relative_poses` or `as_recorded`.
        rows: (T,) the times of the rows, rising; default every time of either stream.
    Raises:
        ValueError: on a measurement at a time without a row.
    """
    clock, moved = (np.asarray(part, np.float64) for part in odometry)
    seen, tag, z = measurements[0], np.asarray(measurements[1]), np.asarray(measurements[2])
    when = np.asarray(seen, np.float64)
    time = np.unique(np.concatenate([clock, when])) if rows is None else np.asarray(rows, float)
    row = np.searchsorted(time, when)
    lost = when[time[np.minimum(row, len(time) - 1)] != when]
    if lost.size:
        raise ValueError(f"align: expected measurements at times of rows, got one at {lost[0]}")
    count = np.bincount(row, minlength=len(time))
    order = np.argsort(row, kind="stable")
    row = row[order]
    slot = np.arange(row.size) - (np.cumsum(count) - count)[row]
    places = len(time), int(np.max(count, initial=0))
    padded_z = np.zeros((*places, z.shape[1]))
    padded_tag = np.full(places, -1, np.int32)
    valid = np.zeros(places, bool)
    padded_z[row, slot] = z[order]
    padded_tag[row, slot] = tag[order]
    valid[row, slot] = True
    return Rows(time, rule(clock, moved, time), padded_z, padded_tag, valid)


def join_slots(scans: Sequence[Rows], places: Sequence[int | None]) -> Rows:
    """Rows at the same times with the slots of several sensors side by side.

    Each is padded to its places (None: to none more), and z to the longest of all.
    """
    size = max(rows.z.shape[2] for rows in scans)
    blocks = []
    for rows, count in zip(scans, places, strict=True):
        spare = 0 if count is None else count - rows.tag.shape[1]
        slots = (0, 0), (0, spare)
        z = np.pad(rows.z, (*slots, (0, size - rows.z.shape[2])))
        tag = np.pad(rows.tag, slots, constant_values=-1)
        blocks.append((z, tag, np.pad(rows.valid, slots)))
    z, tag, valid = (np.concatenate(parts, axis=1) for parts in zip(*blocks, strict=True))
    return Rows(scans[0].time, scans[0].control, z, tag, valid)


def as_recorded(
    clock: Float[np.ndarray, "K"], moved: Float[np.ndarray, "K U"], rows: Float[np.ndarray, "T"]
) -> Float[np.ndarray, "T U"]:
    """The odometry itself, a line a row; raises ValueError where rows have other times."""
    if not np.array_equal(clock, rows):
        raise ValueError("as_recorded: expected a row at each time of the odometry and no other")
    return moved


def hold(
    clock: Float[np.ndarray, "K"], velocity: Float[np.ndarray, "K V"], rows: Float[np.ndarray, "T"]
) -> Float[np.ndarray, "T U"]:
    """The velocity at the row before, and the interval Δt since.

    A velocity holds from its time to the next; it is zero before the first. Of odometry with equal
    times the last counts. Δt = 0 in the first row.
    """
    start = np.concatenate([rows[:1], rows[:-1]])
    latest = np.searchsorted(clock, start, side="right") - 1
    held = np.where((latest >= 0)[:, None], velocity[np.maximum(latest, 0)], 0.0)
    held[:1] = 0.0
    return np.column_stack([held, rows - start])


def divide(
    clock: Float[np.ndarray, "K"],
    moved: Float[np.ndarray, "K 2"],
    rows: Float[np.ndarray, "T"],
    begin: float,
) -> Float[np.ndarray, "T 3"]:
    """Pose increments (T, 3) between successive rows, the first from the time `begin` on.

    A line (distance, turn) of the odometry is a constant twist from the line before to its own
    time; rows in between divide it in proportion.
    """
    edges = np.unique(np.concatenate([[begin], clock, rows]))
    edges = edges[(edges >= begin) & (edges <= rows[-1])]
    ends = np.concatenate([[begin], clock])
    parts = []
    for total in moved.T:
        along = np.interp(edges, ends, np.concatenate([[0.0], np.cumsum(total)]))
        parts.append(np.diff(along))
    heading = np.concatenate([[0.0], np.cumsum(parts[1])])
    middle = heading[:-1] + 0.5 * parts[1]
    track = np.zeros((len(edges), 3))
    track[1:, 0] = np.cumsum(parts[0] * np.cos(middle))
    track[1:, 1] = np.cumsum(parts[0] * np.sin(middle))
    track[:, 2] = heading
    at = np.searchsorted(edges, rows)
    return relative(track[np.concatenate([[0], at[:-1]])], track[at])


def relative_poses(
    clock: Float[np.ndarray, "K"], pose: Float[np.ndarray, "K 3"], rows: Float[np.ndarray, "T"]
) -> Float[np.ndarray, "T 3"]:
    """Pose increments between successive rows of a path of poses, zero to the first row."""
    path = interpolate_poses(clock, pose, rows)
    path[:, 2] = np.unwrap(path[:, 2])
    return relative(np.concatenate([path[:1], path[:-1]]), path)


def interpolate_poses(
    clock: Float[np.ndarray, "K"], pose: Float[np.ndarray, "K 3"], rows: Float[np.ndarray, "T"]
) -> Float[np.ndarray, "T 3"]:
    """Poses at some times, linear in (x, y, θ) between those given; headings in [-π, π]."""
    heading = np.interp(rows, clock, np.unwrap(pose[:, 2]))
    x, y = (np.interp(rows, clock, pose[:, k]) for k in (0, 1))
    return np.column_stack([x, y, np.arctan2(np.sin(heading), np.cos(heading))])


def geodesic_poses(
    clock: Float[np.ndarray, "K"], pose: Float[np.ndarray, "K 3"], rows: Float[np.ndarray, "T"]
) -> Float[np.ndarray, "T 3"]:
    """Poses at some times, at constant velocity on SE(2) between those given; before the first and
    after the last these themselves. Headings in (-π, π]."""
    lower = np.clip(np.searchsorted(clock, rows, side="right") - 1, 0, max(len(clock) - 2, 0))
    upper = np.minimum(lower + 1, len(clock) - 1)
    interval = clock[upper] - clock[lower]
    share = np.clip((rows - clock[lower]) / np.where(interval > 0, interval, 1.0), 0.0, 1.0)
    return compose(pose[lower], part(between(pose[lower], pose[upper]), share))


GAP_FACTOR = 10
"""A longer interval between lines, in multiples of their median, is a gap."""


def is_gap(clock: Float[np.ndarray, "K"], longest: float | None = None) -> Bool[np.ndarray, "_"]:
    """Mask (K - 1,) of the intervals between K lines that are longer than `longest` [s].

    Default: `GAP_FACTOR` times their median, above the rounding of stamps of ten digits.
    """
    steps = np.diff(clock)
    if longest is None:
        longest = GAP_FACTOR * float(np.median(steps)) if steps.size else 0.0
    return np.asarray(steps > longest * (1 + 1e-6) + 1e-6)


def between_lines(
    clock: Float[np.ndarray, "K"],
    rows: Float[np.ndarray, "T"],
    joined: Bool[np.ndarray, "_"],
) -> Bool[np.ndarray, "T"]:
    """Mask of the rows at the time of a line, or between two lines that are joined (K - 1,)."""
    after = np.searchsorted(clock, rows)
    last = len(clock) - 1
    within = np.concatenate([[False], joined, [False]])[after]
    return np.asarray(within | (clock[np.minimum(after, last)] == rows))


def known_poses(
    clock: Float[np.ndarray, "K"],
    pose: Float[np.ndarray, "K 3"],
    rows: Float[np.ndarray, "T"],
    longest: float | None = None,
    interpolate: Interpolation = interpolate_poses,
) -> tuple[Float[np.ndarray, "T 3"], Bool[np.ndarray, "T"]]:
    """Poses at some times as `interpolate` has them, and in which rows they are known; else NaN.

    A pose is unknown before the first line, after the last, in a gap (`is_gap`), over a jump that
    is no motion, and next to a line that is not finite or was written while the robot was lost.
    """
    finite = np.isfinite(pose).all(axis=1)
    if not finite.any():
        return np.full((len(rows), 3), np.nan), np.zeros(len(rows), bool)
    jump, lost = true_path_faults(clock, pose)
    finite &= ~lost
    joined = ~is_gap(clock, longest) & ~jump[1:] & finite[:-1] & finite[1:]
    unusable = clock[~finite]
    is_known = between_lines(clock, rows, joined) & ~np.isin(rows, unusable)
    path = interpolate(clock[finite], pose[finite], rows)
    return np.where(is_known[:, None], path, np.nan), is_known


def true_path_faults(
    clock: Float[np.ndarray, "K"], pose: Float[np.ndarray, "K 3"]
) -> tuple[Bool[np.ndarray, "K"], Bool[np.ndarray, "K"]]:
    """Masks of the finite lines of a true path that a jump leads to, and of those that a tracker
    wrote when it had lost the robot (`lost_lines`)."""
    finite = np.isfinite(pose).all(axis=1)
    jump, lost = np.zeros((2, len(clock)), bool)
    jump[finite] = odometry_jumps(pose[finite], clock[finite])
    lost[finite] = lost_lines(pose[finite], jump[finite])
    return jump, lost


def relative(
    before: Float[np.ndarray, "T 3"], after: Float[np.ndarray, "T 3"]
) -> Float[np.ndarray, "T 3"]:
    """Poses relative to those before; headings are not wrapped."""
    steps = between(before, after)
    steps[:, 2] = after[:, 2] - before[:, 2]
    return steps
