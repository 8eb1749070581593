"""Reader of the Plaza data sets: a lawn mower with range measurements to four radio beacons.

Their files are MAT-files of level 5. SciPy's reader can end the process on a damaged file, so this
one reads matrices of numbers, as MATLAB and SciPy write them. Format: MathWorks, "MAT-File
Format" (2024), chapter 1: a header of 128 bytes, then elements, each a tag (type, bytes) and its
data, padded to 8 bytes; a compressed element holds one more element; a matrix holds elements with
its flags, dimensions, name and numbers, by column.
"""

import math
import struct
import zlib
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxslam.core.logs._streams import between_lines, divide, is_gap, known_poses
from jaxslam.core.types import Log
from jaxslam.datasets._account import Account
from jaxslam.datasets._dataset import Dataset
from jaxslam.datasets._lines import read_bytes
from jaxslam.motion import PoseIncrement
from jaxslam.sensors import RangeOnly

_HEADER = 128
_INTEGERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 12: "i8", 13: "u8"}
_NUMBERS = _INTEGERS | {7: "f4", 9: "f8"}
"""NumPy's name of each type of data"""
_INT32, _UINT32, _MATRIX, _COMPRESSED = 5, 6, 14, 15
_NUMERIC = range(6, 16)
"""classes of matrices that hold numbers: double, single, and integers"""
_COMPLEX = 0x0800
"""bit of a matrix's flags"""


def read_matrices(path: Path) -> dict[str, np.ndarray]:
    """The real matrices of numbers in a file, by name; other variables are left out.

    Raises ValueError, with the path and the byte, on an unreadable file or another format.
    """
    path, content = read_bytes(path)
    mark = content[_HEADER - 2 : _HEADER]
    if mark not in (b"IM", b"MI"):
        raise ValueError(f"{path}: cannot be read: expected a MAT-file of level 5 (save -v7)")
    order = "<" if mark == b"IM" else ">"
    matrices: dict[str, np.ndarray] = {}
    at = _HEADER
    while at < len(content):
        try:
            kind, data, end = _element(content, at, order)
            if kind == _COMPRESSED:
                end = at + 8 + len(data)  # compressed elements are not padded
                kind, data, _ = _element(zlib.decompress(data), 0, order)
            if kind == _MATRIX and (matrix := _matrix(data, order)):
                matrices[matrix[0]] = matrix[1]
        except (ValueError, zlib.error) as problem:
            raise ValueError(f"{path}: damaged at byte {at}: {problem}") from problem
        at = end
    return matrices


def _element(content: bytes, at: int, order: str) -> tuple[int, bytes, int]:
    """Type and data of the element at a byte, and the byte at which the next one begins."""
    if len(content) < at + 8:
        raise ValueError("the file ends within a tag")
    kind, size = struct.unpack_from(f"{order}II", content, at)
    begin, end = at + 8, at + 8 + size + -size % 8
    if kind >> 16:  # at most four bytes, within the tag
        kind, size, begin, end = kind & 0xFFFF, kind >> 16, at + 4, at + 8
        if size > 4:
            raise ValueError(f"expected at most 4 bytes in a tag, got {size}")
    if len(content) < begin + size:
        raise ValueError(f"expected {size:,} bytes of data, got {len(content) - begin:,}")
    return kind, content[begin : begin + size], end


def _matrix(data: bytes, order: str) -> tuple[str, np.ndarray] | None:
    """Name and values of a matrix; None if they are not real numbers."""
    parts: list[tuple[int, bytes]] = []
    at = 0
    while at < len(data) and len(parts) < 4:
        kind, content, at = _element(data, at, order)
        parts.append((kind, content))
    if len(parts) < 4 or parts[0][0] != _UINT32 or len(parts[0][1]) != 8 or parts[1][0] != _INT32:
        return None
    flags = struct.unpack(f"{order}II", parts[0][1])[0]
    if flags & 0xFF not in _NUMERIC or flags & _COMPLEX or parts[3][0] not in _NUMBERS:
        return None
    shape = tuple(np.frombuffer(parts[1][1], f"{order}i4").tolist())
    dtype = np.dtype(order + _NUMBERS[parts[3][0]])
    if min(shape, default=-1) < 0 or math.prod(shape) * dtype.itemsize != len(parts[3][1]):
        raise ValueError(f"{len(parts[3][1]):,} bytes of numbers do not fit dimensions {shape}")
    name = parts[2][1].decode("latin-1")
    return name, np.frombuffer(parts[3][1], dtype).reshape(shape, order="F")


SOURCE = (
    "J. Djugash, B. Hamner, S. Roth, Navigating with ranging radios: five data sets with ground "
    "truth, Journal of Field Robotics 26(9), 2009; Plaza1_.mat and Plaza2_.mat as with GTSAM"
)
_TABLES = {"DR": 3, "TD": 4, "TL": 3, "GT": 4}
MAX_NUMBER = 1e30
"""Largest number of a table: squares and their sums are finite in a filter in float64."""
_COLUMNS = "DR: t, distance, turn; TD: t, sender, receiver, range; TL: id, x, y; GT: t, x, y, θ"
_RANGE_BIAS = (0.03, 0.069)
"""Offset [m] and scale by which the ranges of both files exceed the distances: the least-squares
line through all ranges against the distances between survey and ground truth. It stands for a radio
calibrated beforehand; it is not estimated here."""
_RANGE_COV = ((0.5**2,),)
"""Variance of the ranges after that correction [m²]; successive ranges of a beacon are white."""
_TRAVEL_DENSITY = (0.03**2, 0.03**2, 0.003**2)
"""Variance of forward [m²/m], sideways [m²/m] and heading motion [rad²/m] per metre of travel."""


def plaza(
    path: str | Path,
    *,
    range_bias: tuple[float, float] = _RANGE_BIAS,
) -> Dataset:
    """The data set in `Plaza1_.mat` or `Plaza2_.mat`: odometry, ranges, survey and ground truth.

    The file's tables are DR (t, distance, turn), TD (t, sender, receiver, range), TL (id, x, y of a
    beacon) and GT (t, x, y, θ). The log has a row at the time of every range: its control is the
    pose increment (dx, dy, dθ) of the odometry since the row before, with a proportional part of
    an odometry row that this time divides. Ranges of one time share a row. Dropped and counted are
    ranges before the first ground truth or after the last odometry, or in a gap of it, and all but
    the first range of a beacon at one time. A range z is corrected to (z - offset)/(1 + scale) by
    `range_bias`.

    `true_path` is the ground truth at the time of each row, interpolated linearly, but not in a gap
    or after the last (`true_at`). A gap is an interval above ten times the median. The map's frame
    is the robot's first pose; survey and true path are in another frame.

    Source: Djugash, Hamner & Roth, Journal of Field Robotics 26(9), 2009, as with GTSAM:
    `gtsam.findExampleDataFile("Plaza1_.mat")`.

    Args:
        path: the file.
        range_bias: (offset [m], scale) of the ranges; (0, 0) does not change them.
    Raises:
        ValueError: `path: reason` if the file cannot be read, lacks a table, has a table of
            another shape or not finite, times of odometry or ground truth that do not increase, a
            range that is not positive or of a beacon without a survey.
    """
    tables = _read(Path(path))
    odometry, ranges, survey, truth = (tables[name] for name in _TABLES)
    names = tuple(sorted(int(name) for name in survey[:, 0]))
    for column, kind in ((survey[:, 0], "beacon"), (ranges[:, 2], "receiver")):
        if np.any(column != np.round(column)):
            raise ValueError(f"{path}: a {kind}'s number is not whole")
    if len(set(names)) < len(names):
        raise ValueError(f"{path}: a beacon occurs twice in TL")
    unknown = sorted({int(name) for name in ranges[:, 2]} - set(names))
    if unknown:
        raise ValueError(f"{path}: TD has ranges of beacon {unknown[0]}, which is not in TL")
    if np.any(ranges[:, 3] <= 0):
        raise ValueError(f"{path}: a range in TD is not above 0")
    for name, times in (("DR", odometry[:, 0]), ("GT", truth[:, 0])):
        if np.any(np.diff(times) <= 0):
            raise ValueError(f"{path}: the times of {name} do not rise")

    begin, end = truth[0, 0], odometry[-1, 0]
    ranges = ranges[np.argsort(ranges[:, 0], kind="stable")]
    inside = (ranges[:, 0] > begin) & (ranges[:, 0] <= end)
    edges = np.concatenate([[min(begin, odometry[0, 0])], odometry[:, 0]])
    in_gap = inside & ~between_lines(edges, ranges[:, 0], np.append(True, ~is_gap(odometry[:, 0])))
    outside, inside = ~inside, inside & ~in_gap  # of a gap counted apart
    times, row = np.unique(ranges[inside, 0], return_inverse=True)
    if len(times) == 0:
        raise ValueError(
            f"{path}: no range in TD is between the first ground truth and the last odometry"
            + ", outside of its gaps" * bool(in_gap.any())
        )
    tag = np.searchsorted(names, ranges[inside, 2].astype(int))
    # (row, tag) as one number; `np.unique` returns the first index of each.
    first = np.unique(row * len(names) + tag, return_index=True)[1]
    offset, scale = range_bias
    z = (ranges[inside, 3] - offset) / (1 + scale)
    positive = first[z[first] > 0]
    account = Account({"ranges outside the odometry": int(outside.sum())})
    account.drop("ranges in a gap of the odometry", in_gap.sum())
    repeated, short = int(inside.sum() - len(first)), len(first) - len(positive)
    account.dropped.update({"repeated ranges": repeated, "ranges shorter than their bias": short})
    account.correct(f"ranges: {offset} m and {100 * scale} % subtracted", any(range_bias))
    if not len(positive):
        raise account.none_left(path)
    true_path, true_at = known_poses(truth[:, 0], truth[:, 1:], times)
    points = {int(name): (x, y) for name, x, y in survey}
    return Dataset(
        name="plaza",
        log=Log.from_streams(
            (odometry[:, 0], odometry[:, 1:]),
            (times[row[positive]], tag[positive], z[positive, None]),
            partial(divide, begin=begin),
            times,
        ),
        time=times,
        motion=PoseIncrement(_travel_noise),
        sensor=RangeOnly(_RANGE_COV),
        tags=names,
        landmarks=np.array([points[name] for name in names]),
        true_path=true_path,
        true_at=None if true_at.all() else true_at,
        **account.fields,
        source=SOURCE,
    )


def _read(path: Path) -> dict[str, Float[np.ndarray, "_ _"]]:
    """The tables of a file; raises ValueError on any other content."""
    content = read_matrices(path)
    tables = {}
    for name, columns in _TABLES.items():
        if name not in content:
            raise ValueError(f"{path}: no table {name} in the file ({_COLUMNS})")
        table = content[name]
        if table.ndim != 2 or table.shape[1] != columns or len(table) == 0:
            raise ValueError(
                f"{path}: expected {name} of shape (at least 1, {columns}), got {table.shape} "
                f"({_COLUMNS})"
            )
        if not np.all(np.isfinite(table)):
            raise ValueError(f"{path}: {name} has something other than finite numbers")
        if np.any(np.abs(table) > MAX_NUMBER):
            raise ValueError(f"{path}: {name} has a number beyond ±{MAX_NUMBER:g}")
        tables[name] = table.astype(np.float64)
    return tables


def _travel_noise(pose: jax.Array, u: jax.Array) -> jax.Array:
    """The noise covariance: `_TRAVEL_DENSITY` times the distance travelled."""
    square = u[0] ** 2 + u[1] ** 2
    moved = square > 0
    # The inner `where` keeps the gradient of the root finite at a standstill.
    travel = jnp.where(moved, jnp.sqrt(jnp.where(moved, square, 1.0)), 0.0)
    return travel * jnp.diag(jnp.asarray(_TRAVEL_DENSITY, u.dtype))
