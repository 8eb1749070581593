"""Columns of odometry and measurements, from lists, arrays or data frames, as the rows of a log."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Generic, NamedTuple, Protocol, TypeAlias, TypeVar

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam.core._numbers import is_number
from jaxslam.core._units import TURN, are_headings_in_degrees
from jaxslam.core.logs import _streams as streams
from jaxslam.core.validation import InvalidField
from jaxslam.math._arrays import is_concrete
from jaxslam.math._odometry_jumps import odometry_jumps, step_sizes, without_jumps

UNITS: dict[str, dict[str, float]] = {
    "rad": {"deg": 180 / math.pi},
    "rad/s": {"deg/s": 180 / math.pi},
    "m": {"mm": 1000, "cm": 100},
    "s": {"ms": 1000, "us": 10**6, "ns": 10**9},
}
"""Other units in which a column may be given, and how many of them are one of the model's. Values
are divided by it, so that 1400 ms are the 1.4 s of another file to the bit. Whole numbers are
divided by whole numbers, rounded once: of 19 digits of nanoseconds float64 holds 16."""

TIME, TAG, INTERVAL = "t [s]", "tag", "dt [s]"
POSE = ("x [m]", "y [m]", "theta [rad]")
_INCREMENT = ("forward [m]", "left [m]", "turn [rad]")


_Name = TypeVar("_Name", bound=int | str)
"""of a landmark"""
_Value = TypeVar("_Value")


class _ByName(Protocol):
    """Columns by name: a mapping, a structured array, a data frame."""

    def __getitem__(self, name: str, /) -> Iterable[object]: ...


Tabular: TypeAlias = Sequence[Sequence[object]] | np.ndarray | _ByName
"""Rows, or columns by name."""


class Columns(NamedTuple, Generic[_Name]):
    """Columns of one length by name, and what is said of a cell."""

    columns: dict[str, Float[np.ndarray, "K"]]
    """float64, by name with unit, as "v [m/s]" """
    tags: list[_Name | None] | None
    """the column `TAG`: names, None where unknown; None without such a column"""
    error: Callable[[int, str, str], ValueError]
    """(row, column, reason) -> an error about a cell; as text, also a note: its place and reason"""

    def values(self, names: Sequence[str]) -> np.ndarray:
        """Some columns side by side, (K, len(names))."""
        if not names:  # of a robot without odometry
            return np.zeros((len(self.columns[TIME]), 0))
        return np.column_stack([self.columns[name] for name in names])


_OUTSIDE = "measurements outside the odometry"
_IN_GAP = "measurements in a gap of the odometry"
_NEGATIVE = "measurements with a range below 0"
_BEYOND = "measurements of the maximum range"
_SOON = "measurements closer than the spacing"
_DROPPED = (_OUTSIDE, _IN_GAP, _NEGATIVE, _BEYOND, _SOON)
"""Why measurements are not in the rows; the first is stated with a count of 0, too."""


class Seen(NamedTuple, Generic[_Name]):
    """The measurements of one sensor."""

    table: Columns[_Name]
    measured: tuple[str, ...]
    """the names of z, with units"""
    places: int | None = None
    """its measurement slots in a scan; None for as many as its largest scan has"""
    max_range: float = math.inf
    """[m] the range from which on it says nothing"""
    spacing: float = 0.0
    """[s] the least time between two measurements of a landmark that are kept"""

    def tags_in_scans(self, tag_of: Mapping[_Name, int]) -> Int[np.ndarray, "J"]:
        """The tag of each measurement, -1 where unknown.

        Raises ValueError, with the place, on times that fall, a tag twice at a time, and more
        measurements at a time than slots.
        """
        table, when = self.table, self.table.columns[TIME]
        check_times(table, strict=False)
        named = table.tags or [None] * len(when)
        tags = [-1 if name is None else tag_of.get(name, -1) for name in named]
        scan: set[tuple[float, int]] = set()
        for row, pair in enumerate(zip(when.tolist(), tags, strict=True)):
            if pair[1] >= 0 and pair in scan:
                raise table.error(
                    row,
                    TAG,
                    f"expected a tag once at a time, got {named[row]!r} twice at t = "
                    f"{pair[0]:.12g}",
                )
            scan.add(pair)
        if self.places is not None:
            # Times rise, so more than `places` are equal where one is that so many lines before.
            late = np.flatnonzero(when[self.places :] == when[: -self.places])
            if late.size:
                raise table.error(
                    int(late[0]) + self.places,
                    TIME,
                    f"expected at most {self.places} measurement{'s' * (self.places > 1)} at a "
                    "time, the slots of the sensor, got more",
                )
        return np.array(tags, np.int64)

    def unused(
        self, tag: Int[np.ndarray, "J"], inside: Bool[np.ndarray, "J"]
    ) -> dict[str, Bool[np.ndarray, "J"]]:
        """Masks of the measurements, among those inside, that say nothing or too much, by reason.

        Raises ValueError, with the place, on one of an unknown landmark where there is a spacing.
        """
        values, when = self.table.values(self.measured), self.table.columns[TIME]
        ranges = [k for k, name in enumerate(self.measured) if split_unit(name)[0] == "range"]
        negative = inside & (values[:, ranges] < 0).any(axis=1)
        beyond = inside & (values[:, ranges] >= self.max_range).any(axis=1)
        rest = inside & ~negative & ~beyond
        too_soon = np.zeros(len(tag), bool)
        if self.spacing and (unknown := np.flatnonzero(rest & (tag < 0)).tolist()):
            reason = "expected a tag, since a spacing is of one landmark, got none"
            raise self.table.error(unknown[0], TAG, reason)
        last: dict[int, float] = {}
        for row in np.flatnonzero(rest) if self.spacing else ():
            # A spacing of whole intervals is not to be missed by rounding of the stamps.
            too_soon[row] = when[row] - last.get(tag[row], -math.inf) < self.spacing * (1 - 1e-6)
            if not too_soon[row]:
                last[tag[row]] = when[row]
        return {_NEGATIVE: negative, _BEYOND: beyond, _SOON: too_soon}


class Aligned(NamedTuple, Generic[_Name]):
    """The rows of all tables, and what became of their names and measurements."""

    rows: streams.Rows
    tags: tuple[_Name, ...]
    """the names of the landmarks with tags 0, 1, …"""
    dropped: dict[str, int]


def split_unit(name: str) -> tuple[str, str | None]:
    """Name and unit of a column, ("v", "m/s") of "v [m/s]"; None without a unit."""
    bare, bracket, unit = name.strip().partition("[")
    return bare.strip(), unit.rstrip("] ").strip() if bracket else None


def label(name: str) -> str:
    """The name of a column without its unit, as one word: scale_1 of "scale 1 [1]"."""
    return split_unit(name)[0].replace(" ", "_")


def unit_divisor(unit: str | None, wanted: str) -> float | None:
    """The divisor that converts a column to the wanted unit; None if the units do not fit."""
    target = split_unit(wanted)[1] or ""
    if unit is None or unit == target:
        return 1
    return UNITS.get(target, {}).get(unit.replace("µ", "u").replace("μ", "u"))


def odometry_columns(controls: tuple[str, ...], names: Sequence[str]) -> tuple[str, ...]:
    """The columns for a model's controls, without the time, among those that a table has."""
    measured = tuple(name for name in controls if name != INTERVAL)
    poses = {split_unit(name)[0] for name in POSE} <= {split_unit(name)[0] for name in names}
    return POSE if poses and measured == _INCREMENT else measured


def measurement_columns(measured: tuple[str, ...], landmark: tuple[str, ...]) -> tuple[str, ...]:
    """The columns of measurements: with a tag, unless the sensor has no landmark."""
    return (TIME, *((TAG,) if landmark else ()), *measured)


def align_tables(
    odometry: Columns[_Name],
    sensors: Sequence[Seen[_Name]],
    controls: tuple[str, ...],
    names: Sequence[_Name] = (),
) -> Aligned[_Name]:
    """The rows of odometry and of sensors with different rates (Solà 2.4): a row at every time
    of odometry, and of measurements within it.

    Velocities (controls with an interval) hold until the next line; poses are interpolated, but for
    gaps (`streams.is_gap`); other controls are unchanged, and measurements must then be at their
    times. Measurements before the first or after the last odometry, or in a gap between poses, are
    dropped and counted, as are ranges below 0 or of the sensor's maximum, and measurements sooner
    after one of the same landmark than the spacing. The last velocity holds as long as the longest
    interval between lines. A scan has the slots of the sensors in their order.

    Args:
        controls: the names of the motion model, with units.
        names: of landmarks that have a tag though none may be measured; else those measured.
    Raises:
        ValueError: with the place, on times that do not rise (equal ones are a scan), a tag that
            occurs twice in a scan of a sensor, more measurements than slots, or a measurement
            without odometry at its time.
    """
    clock = odometry.columns[TIME]
    check_times(odometry, strict=True)

    # How the odometry becomes controls, and until when it is one.
    columns = odometry_columns(controls, tuple(odometry.columns))
    end = clock[-1]
    rule: streams.Rule = streams.relative_poses if columns == POSE else streams.as_recorded
    if columns != POSE and INTERVAL in controls and controls[:3] != _INCREMENT:
        rule = streams.hold
        end += np.max(np.diff(clock), initial=0.0)

    # The measurements at whose time there is odometry.
    dropped = dict.fromkeys(_DROPPED, 0)
    inside = []
    for seen in sensors:
        when = seen.table.columns[TIME]
        within = (when >= clock[0]) & (when <= end)
        joined = within
        if columns == POSE:
            joined = within & streams.between_lines(clock, when, ~streams.is_gap(clock))
        dropped[_OUTSIDE] += int((~within).sum())
        dropped[_IN_GAP] += int((within & ~joined).sum())
        inside.append(joined)

    # Tags of the names of their landmarks.
    named = {
        name
        for seen, is_inside in zip(sensors, inside, strict=True)
        for name, kept in zip(seen.table.tags or (), is_inside, strict=False)
        if kept
    }
    tag_of = {name: tag for tag, name in enumerate(sort_names({*names, *named}))}
    tags = [seen.tags_in_scans(tag_of) for seen in sensors]

    # Of these measurements, those that say something.
    used_streams = []
    for seen, tag, is_inside in zip(sensors, tags, inside, strict=True):
        when = seen.table.columns[TIME]
        lost = np.flatnonzero(is_inside & ~np.isin(when, clock))
        if lost.size and rule is streams.as_recorded:
            raise seen.table.error(
                int(lost[0]),
                TIME,
                f"expected a time of the odometry, since {', '.join(columns)} cannot be divided, "
                f"got {when[lost[0]]:.12g}; poses can: {TIME}, {', '.join(POSE)}",
            )
        unused = seen.unused(tag, is_inside)
        for reason, mask in unused.items():
            dropped[reason] += int(mask.sum())
        used = is_inside & ~np.logical_or.reduce(list(unused.values()))
        used_streams.append((when[used], tag[used], seen.table.values(seen.measured)[used]))

    # A row at every time, with the slots of the sensors side by side.
    times = np.unique(np.concatenate([clock, *(when for when, *_ in used_streams)]))
    moved = clock, odometry.values(columns)
    scans = [streams.align_streams(moved, stream, rule, times) for stream in used_streams]
    rows = streams.join_slots(scans, [seen.places for seen in sensors])
    if INTERVAL in controls and rule is not streams.hold:
        interval = np.diff(rows.time, prepend=rows.time[:1])
        rows = rows._replace(control=np.column_stack([rows.control, interval]))
    counts = {reason: n for reason, n in dropped.items() if n or reason == _OUTSIDE}
    return Aligned(rows, tuple(tag_of), counts)


def check_times(table: Columns[_Name], *, strict: bool) -> None:
    """Raise ValueError, with the place, unless times rise; equal ones pass where not strict."""
    time = table.columns[TIME]
    back = np.flatnonzero(np.diff(time) <= 0 if strict else np.diff(time) < 0)
    if back.size:
        before, at = time[back[0] : back[0] + 2].tolist()
        wanted = f"above {before}" if strict else f"of at least {before}"
        raise table.error(int(back[0]) + 1, TIME, f"expected a time {wanted}, got {at}")


DEGREES_OF_PATH = (
    "theta [rad] contradicts the directions between the positions, which fit it as degrees: "
    "write [deg]"
)

LATEST = 1e11
"""Stamp [s] that no clock has; milliseconds since 1970 are above 1e12."""


def wrong_units(table: Columns[_Name]) -> list[str]:
    """Signs that numbers are in other units than those of their columns, a sentence each.

    Angles and turn rates, but for headings, beyond 2π, of the first such column; headings that fit
    a path in degrees; stamps later than any clock has. A sentence ends with the unit to write.
    """
    signs, when = [], table.columns[TIME]
    for name, values in table.columns.items():
        unit = split_unit(name)[1] or ""
        beyond = np.abs(values) > TURN
        if unit in ("rad", "rad/s") and name != POSE[2] and beyond.any():
            row, degrees = int(np.argmax(np.abs(values))), unit.replace("rad", "deg")
            text = (
                f"{int(beyond.sum()):,} of {len(values):,} numbers are beyond 2π, up to "
                f"{values[row]:.6g}: degrees? then write [{degrees}]"
            )
            signs.append(table.error(row, name, text))
            break
    if set(POSE) <= set(table.columns) and are_headings_in_degrees(table.values(POSE)):
        signs.append(table.error(0, POSE[2], DEGREES_OF_PATH))
    if (when > LATEST).any():
        row = int(np.argmax(when))
        text = (
            f"{when[row]:.6g} s is over three thousand years since 1970: milliseconds, "
            "microseconds or nanoseconds? then write [ms], [us] or [ns]"
        )
        signs.append(table.error(row, TIME, text))
    return list(map(str, signs))


def replace_jumps(odometry: Columns[_Name]) -> str:
    """Replace the jumps of odometry that is a path of poses, and say so; "" without a jump."""
    if not set(POSE) <= set(odometry.columns):
        return ""
    path, clock = odometry.values(POSE), odometry.columns[TIME]
    jumps = odometry_jumps(path, clock)
    if not jumps.any():
        return ""
    k = int(np.argmax(jumps))
    length, turn = step_sizes(path)[k]
    for name, column in zip(POSE, without_jumps(path, jumps).T, strict=True):
        odometry.columns[name] = column
    text = (
        f"a jump of the odometry by {length:.3g} m and {np.rad2deg(turn):.3g}° in "
        f"{clock[k] - clock[k - 1]:.3g} s is no motion, {int(jumps.sum()):,} in all: the step "
        "before it takes its place"
    )
    return str(odometry.error(k, POSE[0], text))


def sort_names(names: set[_Name | None]) -> list[_Name]:
    """The names of landmarks, whole numbers before text; None, the unknown one, is left out."""
    named = (name for name in names if name is not None)
    return sorted(named, key=lambda name: (isinstance(name, str), name))


class Table:
    """Cells under names with units, of a file or an argument, and how they become columns.

    A subclass has the cells, reads one, and says where it is.
    """

    header: Sequence[str]
    needs_units = False
    """whether a column without a unit is refused; else it has that of its name"""

    def cells(self, place: int) -> Sequence[Any]:
        """The cells of the column at a place."""
        raise NotImplementedError

    def error(self, reason: str, row: int | None = None, place: int | None = None) -> ValueError:
        """An error about a cell, the column or the header, for the caller to raise."""
        raise NotImplementedError

    def number(self, cell: Any, optional: bool = False) -> Any:
        """The number in a cell; NaN if none is needed; ValueError with the reason."""
        raise NotImplementedError

    def tag(self, cell: Any) -> int | str | None:
        """The name of a landmark in a cell, None if it is unknown; ValueError with the reason."""
        raise NotImplementedError

    @property
    def names(self) -> list[str]:
        """The names of the columns, without units."""
        return [split_unit(name)[0] for name in self.header]

    def place(self, name: str, why: str = "") -> int:
        """The place of a column; ValueError if it is missing or its unit does not fit the name's.

        why: what needs the column, for the message.
        """
        bare, target = split_unit(name)
        if bare not in self.names:
            got = ", ".join(map(repr, self.header))
            raise self.error(f"expected a column {name!r}{f' ({why})' * bool(why)}, got {got}")
        place = self.names.index(bare)
        unit = split_unit(self.header[place])[1]
        is_unknown = self.needs_units if unit is None else unit_divisor(unit, name) is None
        if target is not None and is_unknown:
            units = " or ".join(f"[{unit}]" for unit in (target, *UNITS.get(target, {})))
            raise self.error(f"expected a unit {units}, got {self.header[place]!r}", place=place)
        return place

    def columns(
        self, wanted: Sequence[str], why: str = "", optional: Sequence[str] = ()
    ) -> Columns[int | str]:
        """The columns `wanted`, as "v [m/s]", in the units of their names.

        Raises ValueError on a column that is missing or has another unit, a cell that is not a
        number, and a tag that is no name.

        Args:
            why: what needs the columns, for messages.
            optional: columns in which a cell without a value is NaN.
        """
        places = {name: self.place(name, why) for name in wanted}
        numbers = {
            name: self.numbers(place, name, name in optional)
            for name, place in places.items()
            if name != TAG
        }
        tags = list(self._read(places[TAG], self.tag)) if TAG in places else None
        return Columns(numbers, tags, lambda row, name, text: self.error(text, row, places[name]))

    def numbers(self, place: int, name: str = "", optional: bool = False) -> Float[np.ndarray, "K"]:
        """The column at a place in the unit of a name, as float64; see `columns`."""
        divisor = unit_divisor(split_unit(self.header[place])[1], name) or 1

        def quotient(cell: Any) -> float:
            # A whole number by a whole number, rounded once.
            return float(self.number(cell, optional) / divisor)

        return np.fromiter(self._read(place, quotient), np.float64)

    def _read(self, place: int, read: Callable[[Any], _Value]) -> Iterator[_Value]:
        """What a function reads in each cell of a column; its errors get the place."""
        for row, cell in enumerate(self.cells(place)):
            try:
                yield read(cell)
            except ValueError as problem:
                raise self.error(str(problem), row, place) from None


class _Argument(Table):
    """The columns of an argument, by their place in the header."""

    def __init__(self, argument: str, header: Sequence[str]) -> None:
        self.argument = argument
        self.header = header
        self.by_place: dict[int, Sequence[object]] = {}

    def cells(self, place: int) -> Sequence[object]:
        return self.by_place[place]

    def error(self, reason: str, row: int | None = None, place: int | None = None) -> InvalidField:
        where = "" if row is None or place is None else f", row {row}, column {self.names[place]}"
        return InvalidField(self.argument + where, reason)

    def number(self, cell: object, optional: bool = False) -> int | float:
        value = _scalar(cell)
        if is_number(value):
            return value
        raise ValueError(f"expected a finite number, got {cell!r}")

    def tag(self, cell: object) -> int | str | None:
        return _landmark(cell)


def columns_of(
    argument: str, table: Tabular, wanted: Callable[[Sequence[str]], Sequence[str]]
) -> Columns[int | str]:
    """The table of a data frame, a mapping of columns, a structured array, or a sequence of rows.

    Columns with names are found by name; a name may have a unit ("bearing [deg]"). Without names
    the columns are in the order wanted. Other columns are left out.

    Args:
        argument: the name of the argument, for messages.
        wanted: (names of the table) -> the columns needed, with units.
    Raises:
        ValueError: on a column that is missing, in another unit, of another length, or with a value
            that is not a finite number.
    """
    table = _to_numpy(table)
    names = _names(table)
    needed = list(wanted(names or ()))
    cells = _Argument(argument, needed if names is None else names)
    if names is None:
        without_axes = isinstance(table, np.ndarray) and table.ndim == 0
        if without_axes or not isinstance(table, Sequence | np.ndarray):
            raise cells.error(f"expected rows or columns, got {type(table).__name__}")
        rows = [_to_numpy(row) for row in table]
        for k, row in enumerate(rows):
            size = len(row) if isinstance(row, Sequence) or np.ndim(row) else 1
            if size != len(needed) or isinstance(row, str):
                reason = f"expected {len(needed)} values ({', '.join(needed)}), got {size}"
                raise InvalidField(f"{argument}, row {k}", reason)
        cells.by_place = {i: [row[i] for row in rows] for i in range(len(needed))}
    else:
        assert not isinstance(table, Sequence)  # which has no names
        for name in needed:
            place = cells.place(name)
            column = _to_numpy(table[names[place]])
            if not isinstance(column, Iterable):
                raise cells.error(f"expected a column {name!r}, got {column!r}")
            cells.by_place[place] = list(column)
        lengths = {names[place]: len(column) for place, column in cells.by_place.items()}
        if len(set(lengths.values())) > 1:
            raise cells.error(f"expected columns of one length, got {lengths}")
    columns = cells.columns(needed)
    if not columns.columns[TIME].size:
        raise cells.error("expected at least one row, got none")
    return columns


def _to_numpy(value: Any) -> Any:
    """A JAX array as NumPy's; a traced one and anything else are unchanged, and then refused."""
    return np.asarray(value) if isinstance(value, jax.Array) and is_concrete(value) else value


def _names(table: Tabular) -> tuple[str, ...] | None:
    """The names of the columns, or None where they have none."""
    if isinstance(table, Mapping):
        return tuple(map(str, table))
    if isinstance(table, np.ndarray):
        return None if table.dtype.names is None else tuple(table.dtype.names)
    columns = getattr(table, "columns", None)
    return None if columns is None else tuple(map(str, columns))


def _scalar(value: object) -> object:
    """The Python number or text of a scalar, or an array without axes, of NumPy or JAX.

    None of a masked one. Times of NumPy, whose numbers have units of their own, are unchanged.
    """
    value = _to_numpy(value)
    if value is np.ma.masked:
        return None
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value[()]
    if not isinstance(value, np.generic) or isinstance(value, np.datetime64 | np.timedelta64):
        return value
    item: object = value.item()
    return float(item) if isinstance(item, np.floating) else item  # of a long double


def _landmark(value: object) -> int | str | None:
    """The name of a landmark, an int or a str; None where it is unknown (None, "", -1 or NaN).

    Raises ValueError with the reason.
    """
    value = _scalar(value)
    try:
        unknown = value is None or bool(value != value) or value in ("", -1)
    except TypeError:  # the truth of a comparison with pandas' <NA> is not defined
        unknown = True
    except ValueError:  # an array
        unknown = False
    if unknown:
        return None
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, int | str):
        raise ValueError(f"expected a whole number or text, got {value!r}")
    if isinstance(value, int) and value < 0:
        raise ValueError(f"expected a number >= 0, or -1 for unknown, got {value}")
    return value
