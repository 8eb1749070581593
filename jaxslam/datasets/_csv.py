"""CSV files with names and units in the header, as spreadsheets and data frames write them."""

import csv
import io
import math
import re
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path

from jaxslam.core.logs._tables import Table, split_unit
from jaxslam.core.validation import InvalidFile
from jaxslam.datasets._lines import DIGITS, LARGEST, read_bytes

MISSING = frozenset(
    {"", "nan", "-nan", "<na>", "na", "n/a", "#n/a", "#na", "null", "none"}
    | {f"{sign}1.#{kind}" for sign in ("", "-") for kind in ("ind", "qnan")}
)
"""Cells without a value, as pandas reads them, in lower case."""

_MAX_NAME = 100
"""Largest number of characters of a landmark's name: a longer cell is a sign of a wrong column."""

_SIGNED = re.compile(r"[+-]?(?:\d+[.,]\d*|[.,]\d+)(?:[eE][+-]?\d+)?", re.ASCII)
"""A number with one decimal sign."""
_GROUPED = re.compile(r"[+-]?[1-9]\d{0,2}[.,]\d{3}")
"""A number that may also be grouped by thousands: 1,234."""

_SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs"}


class CsvTable(Table):
    """The cells of a CSV file (UTF-8, any line ends) below its header.

    It is NAME or NAME.gz. Every column but `tag` has its unit in the header, as in `v [m/s]`. Lines
    above the header that begin with # are comments. The header, or a line `sep=;` above it, shows
    whether commas, semicolons or tabs separate cells. Decimal commas are read where no other number
    of the file has a point, and some number cannot be one of thousands; `dialect` says so.
    Raises ValueError if the file cannot be read, has no line below its header, or a line with
    another number of cells.
    """

    def __init__(
        self, path: str | Path, *, needs_units: bool = True, may_be_empty: bool = False
    ) -> None:
        self.needs_units = needs_units
        self.path, data = read_bytes(path)
        lines = self._split(self._decode(data))
        if not lines and not may_be_empty:
            raise self._error(1, "expected a header, as 't [s],v [m/s]', got no text")
        self.head_line, header = lines[0] if lines else (1, [])
        self.lines = [number for number, _ in lines[1:]]
        self.rows = [cells for _, cells in lines[1:]]
        self.header = [" ".join(name.split()) for name in header]  # messages quote it
        if header and all(math.isfinite(_number(cell.replace(",", "."))) for cell in header):
            raise self.error(f"expected a header, as 't [s],v [m/s]', got {header[0]!r}")
        if not self.rows and not may_be_empty:
            raise self.error("expected lines below the header, got none")
        names = self.names
        for place, name in enumerate(names):
            if name in names[:place]:
                raise self.error(f"the column {name!r} occurs twice", place=place)
        for number, cells in zip(self.lines, self.rows, strict=True):
            if len(cells) != len(self.header):
                raise self._count_error(number, cells)
        signs = {"," if "," in cell else "." for cell in self._decimals()}
        self.decimal = "," if signs == {","} else "."
        # A point is a decimal point, but not surely beside semicolons: where a comma is the decimal
        # sign, Excel writes semicolons between cells and a point between thousands.
        self._ambiguous = (self.decimal == "," or self.separator == ";") and all(
            _GROUPED.fullmatch(cell) for cell in self._decimals()
        )

    def _decode(self, data: bytes) -> str:
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError as problem:
            line = data.count(b"\n", 0, problem.start) + 1
            raise self._error(line, "expected text in UTF-8") from problem
        if "\0" in text:
            raise self._error(
                text.count("\n", 0, text.index("\0")) + 1, "expected text, got a zero byte"
            )
        return text

    def _split(self, text: str) -> list[tuple[int, list[str]]]:
        """The cells of each line that has some, with its number; sets `separator`."""
        above = 0  # number of lines above `text`
        # Comments are cut off first: `csv` would pair a quotation mark in them with a later one.
        while text.lstrip(" \t\r\n").startswith("#"):
            _, _, text = text.partition("\n")
            above += 1
        separator = None
        if marked := re.match(r"\s*\"?sep=(.)\"?[^\S\r\n]*(?=[\r\n]|$)", text, re.IGNORECASE):
            separator, text = marked[1], text[marked.end() :]
            above += marked[0].count("\n")
            if separator not in _SEPARATORS:
                raise self._error(
                    above + 1, f"expected sep= and , or ; or a tab, got {separator!r}"
                )
        first = re.search(r"[^\r\n]*\S[^\r\n]*", text)
        separators = _separators(first[0] if first else "")
        if separator is None and len(separators) > 1:
            got = " and ".join(map(repr, separators))
            line = above + 1 + text.count("\n", 0, first.start() if first else 0)
            raise self._error(line, f"expected one separator of cells in the header, got {got}")
        self.separator = separator or (separators or ",")[0]
        reader = csv.reader(io.StringIO(text, newline=""), delimiter=self.separator)
        lines, begins = [], above + 1  # a cell in quotes may go over several lines of the file
        try:
            for cells in reader:
                lines.append((begins, [cell.strip() for cell in cells]))
                begins = above + reader.line_num + 1
        except csv.Error as problem:
            reason = f"expected cells separated by {_SEPARATORS[self.separator]}: {problem}"
            raise self._error(begins, reason) from problem
        return [(number, cells) for number, cells in lines if any(cells)]

    def _count_error(self, line: int, cells: list[str]) -> ValueError:
        """The error about a line with another number of cells than the header."""
        expected, hint = len(self.header), ""
        if "\n" in "".join(cells):
            hint = "; a quotation mark is not closed on its line"
        elif len(cells) > expected and self.separator == ",":
            hint = "; write a number with a point: 0.5"
        reason = f"expected {expected} cells, as in line {self.head_line}, got {len(cells)}{hint}"
        return self._error(line, reason)

    @property
    def dialect(self) -> str:
        """The separators and decimal signs in words; empty for commas and points."""
        decimals = ", decimal commas" * (self.decimal == ",")
        if self.separator == "," and not decimals:
            return ""
        return f"{self.path.name}: cells separated by {_SEPARATORS[self.separator]}{decimals}"

    def unused(self, wanted: Sequence[str]) -> list[str]:
        """The columns of the file that are not wanted."""
        bare = {split_unit(name)[0] for name in wanted}
        return [name for name in self.header if split_unit(name)[0] not in bare]

    def _decimals(self) -> Iterator[str]:
        """The numbers with one decimal sign."""
        return (cell for cells in self.rows for cell in cells if _SIGNED.fullmatch(cell))

    def _value(self, cell: str) -> float:
        """The number in a cell by the decimal sign of the file; NaN of other text."""
        if _SIGNED.fullmatch(cell):
            return math.nan if self._ambiguous else _number(cell.replace(self.decimal, "."))
        return _number(cell)

    def number(self, cell: str, optional: bool = False) -> float | Fraction:
        """A large number is exact, since stamps in nanoseconds are divided."""
        value = self._value(cell)
        if 2**53 <= abs(value) <= LARGEST:
            return Fraction(cell.replace(self.decimal, "."))
        if abs(value) <= LARGEST or (optional and cell.lower() in MISSING):
            return value
        kind = f"number within ±{LARGEST:g}" if math.isfinite(value) else "finite number"
        hint = " (write a point: 0.5, and no thousands separator)" if "," in cell else ""
        if self._ambiguous and _SIGNED.fullmatch(cell):
            hint = " (decimals or thousands? separate cells by commas, write a point: 0.5)"
        raise ValueError(f"expected a {kind}, got {cell!r}{hint}")

    def tag(self, cell: str) -> int | str | None:
        """A name: 11 of 11.0, which pandas writes; text; None if unknown."""
        value = self._value(cell)
        if cell.lower() in MISSING or value == -1:
            return None
        if cell.isascii() and cell.isdigit():
            if len(cell) > DIGITS:
                raise ValueError(f"expected at most {DIGITS} digits, got {len(cell)}")
            return int(cell)
        if math.isnan(value) and not _SIGNED.fullmatch(cell):
            if not (cell.isprintable() and len(cell) <= _MAX_NAME):
                expected = f"a name of at most {_MAX_NAME} characters in one line"
                raise ValueError(f"expected {expected}, got {cell!r:.80}")
            return cell
        if not (value.is_integer() and 0 <= value < 2**53):
            expected = "a whole number >= 0, or nothing if unknown, or a name"
            raise ValueError(f"expected {expected}, got {cell!r}")
        return int(value)

    def cells(self, place: int) -> list[str]:
        return [cells[place] for cells in self.rows]

    def error(self, reason: str, row: int | None = None, place: int | None = None) -> InvalidFile:
        return self._error(self.head_line if row is None else self.lines[row], reason, place)

    def _error(self, line: int, reason: str, place: int | None = None) -> InvalidFile:
        column = None if place is None else f"column {place + 1} ({self.header[place]})"
        return InvalidFile(self.path, reason, line, column)


def _separators(header: str) -> list[str]:
    """The characters that may separate the cells of a header.

    Preferred are those that leave no other separator within a cell, as in "a;b,c".
    """

    def cells(separator: str) -> list[str]:
        try:
            return next(csv.reader([header], delimiter=separator), [])
        except csv.Error:
            return []

    cells_by_separator = {separator: cells(separator) for separator in _SEPARATORS}
    possible = [separator for separator, parts in cells_by_separator.items() if len(parts) > 1]
    clean = [
        separator
        for separator in possible
        if not any(
            character in cell.strip()
            for character in possible
            for cell in cells_by_separator[separator]
        )
    ]
    return clean or possible


def _number(cell: str) -> float:
    """The number in a cell, or NaN."""
    try:
        return math.nan if "_" in cell else float(cell)  # float() alone accepts 1_000
    except ValueError:
        return math.nan
