"""Text files, packed by gzip or not, read line by line; errors as `path:line: reason`."""

import gzip
import math
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jaxslam.core.validation import InvalidFile

DIGITS = 18
"""Digits of the largest whole number that is read; it fits 64 bits."""

LARGEST = 1e60
"""Largest number that is read: products of five such numbers are finite in float64."""


def stored_file(path: str | Path) -> Path | None:
    """The path of the file NAME, else of NAME.gz beside it, else None."""
    path = Path(path)
    return next((file for file in (path, Path(f"{path}.gz")) if file.exists()), None)


def read_bytes(path: str | Path) -> tuple[Path, bytes]:
    """The path of NAME or else NAME.gz, and its bytes, unpacked if it ends in .gz.

    Raises ValueError, `path: cannot be read: reason`, if neither can be read, or a packed file is
    damaged or ends early.
    """
    file = stored_file(path) or Path(path)
    try:
        data = file.read_bytes()
        return file, gzip.decompress(data) if file.suffix == ".gz" else data
    except (OSError, EOFError, zlib.error) as problem:
        reason = getattr(problem, "strerror", None) or f"expected a gzip file, but {problem}"
        raise ValueError(f"{file}: cannot be read: {reason}") from problem


class TextFile:
    """The lines of a small table in a text file, NAME or NAME.gz.

    Iteration yields (line number from 1, fields split at white space), without blank lines and
    lines that start with `comment`. Raises ValueError if the file cannot be read.
    """

    def __init__(self, path: str | Path, comment: str | None = None) -> None:
        self.path, data = read_bytes(path)
        self.comment = comment
        try:
            self.lines = data.decode("utf-8-sig").split("\n")
        except UnicodeDecodeError as problem:
            line = data.count(b"\n", 0, problem.start) + 1
            raise self.error(line, "this is not text") from problem

    def __iter__(self) -> Iterator[tuple[int, list[str]]]:
        for number, text in enumerate(self.lines, start=1):
            fields = text.split()
            if fields and not (self.comment and fields[0].startswith(self.comment)):
                yield number, fields

    def error(self, line: int, reason: str) -> InvalidFile:
        """An InvalidFile about a line, for the caller to raise."""
        return InvalidFile(self.path, reason, line)

    def end_error(self, reason: str) -> InvalidFile:
        """An InvalidFile about the end of the file, for the caller to raise."""
        return self.error(max(len(self.lines) - (self.lines[-1] == ""), 1), reason)

    def numbers(self, line: int, fields: Sequence[str], names: Sequence[str]) -> list[float]:
        """The fields of a line as numbers within ±`LARGEST`, one per name; ValueError otherwise."""
        self.expect(line, fields, names)
        try:
            values = [float(field) for field in fields]
        except ValueError:
            values = []
        # All fields at once, since files are long; one by one only to name the wrong one.
        # float() also accepts 1_000.
        finite = values and all(map(math.isfinite, values))
        if not finite or max(map(abs, values)) > LARGEST or "_" in "".join(fields):
            for name, field in zip(names, fields, strict=True):
                if not _is_finite(field):
                    raise self.error(line, f"{name} is not a finite number: {field!r}")
                if abs(float(field)) > LARGEST:
                    raise self.error(line, f"{name} is beyond ±{LARGEST:g}: {field}")
        return values

    def table(self, names: Sequence[str]) -> tuple[list[int], NDArray[np.float64]]:
        """The numbers of each line and the number of each; ValueError as `numbers`, and of none."""
        rows = {line: self.numbers(line, fields, names) for line, fields in self}
        if not rows:
            raise self.end_error(f"expected lines {' '.join(names)}, got none")
        return list(rows), np.array([*rows.values()])

    def identity(self, line: int, field: str, name: str) -> int:
        """A field as a whole number >= 0; raises ValueError otherwise."""
        if not (field.isascii() and field.isdigit()):
            raise self.error(line, f"{name} is not a whole number >= 0: {field!r}")
        if len(field) > DIGITS:
            raise self.error(line, f"{name} has {len(field)} digits, expected at most {DIGITS}")
        return int(field)

    def expect(self, line: int, fields: Sequence[str], names: Sequence[str]) -> None:
        """Raise ValueError unless a line has one field for each name."""
        if len(fields) != len(names):
            expected = f"{len(names)} fields ({' '.join(names)})"
            raise self.error(line, f"expected {expected}, got {len(fields)}")


def _is_finite(field: str) -> bool:
    """Whether a field is a finite number."""
    try:
        return math.isfinite(float(field)) and "_" not in field
    except ValueError:
        return False
