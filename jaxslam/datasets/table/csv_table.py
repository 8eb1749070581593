"""CSV files with a header of names and units; errors as `path:line: column 2 (v [m/s]): reason`."""

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxslam.core.logs.tables import TAG, UNITS, Columns, split_unit, unit_divisor
from jaxslam.datasets.lines import read_bytes


class CsvTable:
    """The cells of a CSV file (UTF-8, separated by commas, any line ends) below its header.

    It is NAME or NAME.gz. Every column but `tag` has its unit in the header, as in `v [m/s]`. Lines
    above the header that begin with # are comments.
    Raises ValueError where the file cannot be read, has no line below its header, or a line with
    another number of cells.
    """

    def __init__(self, path: str | Path) -> None:
        self.path, data = read_bytes(path)
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError as problem:
            line = data.count(b"\n", 0, problem.start) + 1
            raise ValueError(f"{self.path}:{line}: expected text in UTF-8") from problem
        if "\0" in text:
            raise self._error(
                text.count("\n", 0, text.index("\0")) + 1, "expected text, got a zero byte"
            )
        above = 0
        while text.lstrip(" \t\r\n").startswith("#"):  # with its quotes, which csv would pair
            _, _, text = text.partition("\n")
            above += 1
        reader = csv.reader(io.StringIO(text, newline=""))
        lines = [(above + reader.line_num, [cell.strip() for cell in cells]) for cells in reader]
        lines = [(number, cells) for number, cells in lines if any(cells)]
        if not lines:
            raise ValueError(f"{self.path}:1: expected a header, as 't [s],v [m/s]', got no text")
        self.head_line, self.header = lines[0]
        self.lines = [number for number, _ in lines[1:]]
        self.cells = [cells for _, cells in lines[1:]]
        if len(self.header) == 1 and ";" in self.header[0]:
            raise self._error(self.head_line, "expected cells separated by commas, got ';'")
        if all(math.isfinite(_number(cell)) for cell in self.header):
            raise self._error(
                self.head_line, f"expected a header, as 't [s],v [m/s]', got {self.header[0]!r}"
            )
        if not self.cells:
            raise self._error(self.head_line, "expected lines below the header, got none")
        self.names = [split_unit(name)[0] for name in self.header]
        for place, name in enumerate(self.names):
            if name in self.names[:place]:
                raise self._error(self.head_line, f"the column {name!r} occurs twice", place)
        for number, cells in zip(self.lines, self.cells, strict=True):
            if len(cells) != len(self.header):
                wanted, hint = len(self.header), ""
                if len(cells) > wanted:
                    hint = "; a number has a point, no comma: 0.5"
                raise self._error(
                    number,
                    f"expected {wanted} cells, as in line {self.head_line}, got {len(cells)}{hint}",
                )

    def table(self, wanted: Sequence[str], why: str) -> Columns[int]:
        """The wanted columns ("v [m/s]"), in their units.

        Raises ValueError on a column that is missing, without unit or in another one, a cell that
        is no finite number, and a tag that is no whole number >= 0 (or empty, for unknown).

        Args:
            why: what wants them, for messages.
        """
        places = {name: self._place(name, why) for name in wanted}

        def at(row: int, column: str) -> str:
            return f"{self.path}:{self.lines[row]}: {self._column(places[column])}"

        columns = {n: self._numbers(place, n) for n, place in places.items() if n != TAG}
        return Columns(columns, self._tags(places[TAG]) if TAG in places else None, at)

    def unused(self, wanted: Sequence[str]) -> list[str]:
        """The columns of the file that are not among those wanted."""
        bare = {split_unit(name)[0] for name in wanted}
        return [
            whole for whole, name in zip(self.header, self.names, strict=True) if name not in bare
        ]

    def _place(self, name: str, why: str) -> int:
        bare = split_unit(name)[0]
        if bare not in self.names:
            got = ", ".join(map(repr, self.header))
            raise self._error(self.head_line, f"expected a column {name!r} ({why}), got {got}")
        place = self.names.index(bare)
        unit, target = split_unit(self.header[place])[1], split_unit(name)[1]
        if target is None:
            return place
        if unit is None or unit_divisor(unit, name) is None:
            known = " or ".join(f"[{one}]" for one in (target, *UNITS.get(target, {})))
            raise self._error(
                self.head_line, f"expected a unit {known}, got {self.header[place]!r}", place
            )
        return place

    def _numbers(self, place: int, name: str) -> np.ndarray:
        divisor = unit_divisor(split_unit(self.header[place])[1], name)
        values = np.empty(len(self.cells))
        for row, cells in enumerate(self.cells):
            values[row] = _number(cells[place])
        if not np.isfinite(values).all():
            row = int(np.flatnonzero(~np.isfinite(values))[0])
            cell = self.cells[row][place]
            hint = " (write a point: 0.5)" if "," in cell else ""
            raise self._error(
                self.lines[row], f"expected a finite number, got {cell!r}{hint}", place
            )
        return values / (divisor or 1.0)

    def _tags(self, place: int) -> list[int | None]:
        tags: list[int | None] = []
        for number, cells in zip(self.lines, self.cells, strict=True):
            cell = cells[place]
            if cell and not (cell.isascii() and cell.isdigit()):
                reason = f"expected a whole number >= 0, or nothing if unknown, got {cell!r}"
                raise self._error(number, reason, place)
            tags.append(int(cell) if cell else None)
        return tags

    def _column(self, place: int) -> str:
        return f"column {place + 1} ({self.header[place]})"

    def _error(self, line: int, reason: str, place: int | None = None) -> ValueError:
        where = "" if place is None else f"{self._column(place)}: "
        return ValueError(f"{self.path}:{line}: {where}{reason}")


def _number(cell: str) -> float:
    """The number in a cell; NaN where there is none. float() alone accepts 1_000."""
    try:
        return math.nan if "_" in cell else float(cell)
    except ValueError:
        return math.nan
