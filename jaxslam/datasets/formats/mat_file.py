"""Matrices of numbers in a MAT-file of level 5, as MATLAB and SciPy write them.

SciPy's own reader can end the process on a damaged file. Format: MathWorks, "MAT-File Format"
(2024), chapter 1: a header of 128 bytes, then elements, each a tag (type, bytes) and its data,
padded to 8 bytes; a compressed element holds one more element; a matrix holds elements with its
flags, dimensions, name and numbers, by column.
"""

import math
import struct
import zlib
from pathlib import Path

import numpy as np

from jaxslam.datasets.formats.lines import read_bytes

_HEADER = 128
_INTEGERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 12: "i8", 13: "u8"}
_NUMBERS = _INTEGERS | {7: "f4", 9: "f8"}
"""NumPy's name of a type of data"""
_INT32, _UINT32, _MATRIX, _COMPRESSED = 5, 6, 14, 15
_NUMERIC = range(6, 16)
"""classes of matrices that hold numbers: double, single, and integers"""
_COMPLEX = 0x0800


def read_matrices(path: Path) -> dict[str, np.ndarray]:
    """The real matrices of numbers in a file, by name; other variables are left out.

    Raises ValueError, which begins with the path and says at which byte, on anything else than such
    a file, and where it cannot be read.
    """
    path, content = read_bytes(path)
    mark = content[_HEADER - 2 : _HEADER]
    if mark not in (b"IM", b"MI"):
        raise ValueError(f"{path}: cannot be read: expected a MAT-file of level 5 (save -v7)")
    order = "<" if mark == b"IM" else ">"
    found: dict[str, np.ndarray] = {}
    at = _HEADER
    while at < len(content):
        try:
            kind, data, end = _element(content, at, order)
            if kind == _COMPRESSED:
                end = at + 8 + len(data)  # these are not padded
                kind, data, _ = _element(zlib.decompress(data), 0, order)
            if kind == _MATRIX and (matrix := _matrix(data, order)):
                found[matrix[0]] = matrix[1]
        except (ValueError, zlib.error) as problem:
            raise ValueError(f"{path}: damaged at byte {at}: {problem}") from problem
        at = end
    return found


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
    """Name and values of a matrix; None where they are not real numbers."""
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
