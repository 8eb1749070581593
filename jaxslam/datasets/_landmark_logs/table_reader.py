"""Reader of your data: CSV files with units in the header, and a file of settings."""

import csv
import io
import math
import re
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path

import jax
import numpy as np

from jaxslam.calibration import delayed
from jaxslam.core._units import are_headings_in_degrees
from jaxslam.core.logs import _tables as tables
from jaxslam.core.logs._streams import is_gap, known_poses, true_path_faults
from jaxslam.core.logs._tables import POSE, TAG, TIME, UNITS, Columns, split_unit, unit_divisor
from jaxslam.core.protocols import Motion, Sensor
from jaxslam.core.types import Log
from jaxslam.core.validation import InvalidFile
from jaxslam.datasets._dataset import Adjustable, Dataset, Parameter
from jaxslam.datasets._landmark_logs.table_models import Parametric
from jaxslam.datasets._landmark_logs.table_settings import UNMEASURED, TableSettings
from jaxslam.datasets._lines import DIGITS, LARGEST, none_left, read_bytes, stored_file
from jaxslam.math._odometry_jumps import step_sizes
from jaxslam.simulation.spurious import Spurious

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


class CsvTable:
    """The cells of a CSV file (UTF-8, any line ends) below its header.

    It is NAME or NAME.gz. Every column but `tag` has its unit in the header, as in `v [m/s]`. Lines
    above the header that begin with # are comments. The header, or a line `sep=;` above it, shows
    whether commas, semicolons or tabs separate cells. Decimal commas are read where no other number
    of the file has a point, and some number cannot be one of thousands; `dialect` says so.
    Raises ValueError if the file cannot be read, has no line below its header, or a line with
    another number of cells.
    """

    def __init__(self, path: str | Path) -> None:
        self.path, data = read_bytes(path)
        lines = self._split(self._decode(data))
        if not lines:
            raise ValueError(f"{self.path}:1: expected a header, as 't [s],v [m/s]', got no text")
        self.head_line, header = lines[0]
        self.lines = [number for number, _ in lines[1:]]
        self.cells = [cells for _, cells in lines[1:]]
        self.header = [" ".join(name.split()) for name in header]  # messages quote it
        self.names = [split_unit(name)[0] for name in self.header]
        if all(math.isfinite(_number(cell.replace(",", "."))) for cell in header):
            raise self._error(
                self.head_line, f"expected a header, as 't [s],v [m/s]', got {header[0]!r}"
            )
        if not self.cells:
            raise self._error(self.head_line, "expected lines below the header, got none")
        for place, name in enumerate(self.names):
            if name in self.names[:place]:
                raise self._error(self.head_line, f"the column {name!r} occurs twice", place)
        for number, cells in zip(self.lines, self.cells, strict=True):
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
            raise ValueError(f"{self.path}:{line}: expected text in UTF-8") from problem
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

    def table(
        self, wanted: Sequence[str], why: str, optional: Sequence[str] = ()
    ) -> Columns[int | str]:
        """The columns `wanted`, as "v [m/s]", in the units of their names.

        Raises ValueError on a column that is missing, or without a known unit, a cell that is not a
        finite number, and a tag that is a number, but not a whole one >= 0. A tag is unknown in a
        cell of `MISSING`, and of -1.

        Args:
            why: what needs the columns, for messages.
            optional: columns in which a cell of `MISSING` is NaN.
        """
        places = {name: self._place(name, why) for name in wanted}

        def at(row: int, column: str) -> str:
            return f"{self.path}:{self.lines[row]}: {self._column(places[column])}"

        columns = {
            n: self._numbers(place, n, n in optional) for n, place in places.items() if n != TAG
        }
        return Columns(columns, self._tags(places[TAG]) if TAG in places else None, at)

    def unused(self, wanted: Sequence[str]) -> list[str]:
        """The columns of the file that are not wanted."""
        bare = {split_unit(name)[0] for name in wanted}
        return [
            column for column, name in zip(self.header, self.names, strict=True) if name not in bare
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
            units = " or ".join(f"[{name}]" for name in (target, *UNITS.get(target, {})))
            raise self._error(
                self.head_line, f"expected a unit {units}, got {self.header[place]!r}", place
            )
        return place

    def _decimals(self) -> Iterator[str]:
        """The numbers with one decimal sign."""
        return (cell for cells in self.cells for cell in cells if _SIGNED.fullmatch(cell))

    def _value(self, cell: str) -> float:
        """The number in a cell by the decimal sign of the file; NaN of other text."""
        if _SIGNED.fullmatch(cell):
            return math.nan if self._ambiguous else _number(cell.replace(self.decimal, "."))
        return _number(cell)

    def _numbers(self, place: int, name: str, optional: bool) -> np.ndarray:
        divisor = unit_divisor(split_unit(self.header[place])[1], name) or 1
        values = np.empty(len(self.cells))
        missing = np.zeros(len(self.cells), bool)
        for row, cells in enumerate(self.cells):
            value = self._value(cells[place])
            if isinstance(divisor, int) and divisor > 1 and 2**53 <= abs(value) <= LARGEST:
                # Stamps in nanoseconds: float64 does not hold them before they are divided.
                exact = Fraction(cells[place].replace(self.decimal, ".")) / divisor
                values[row] = float(exact)
            else:
                values[row] = value / divisor
            missing[row] = optional and cells[place].lower() in MISSING
        usable = missing | (np.abs(values) <= LARGEST)
        if not usable.all():
            row = int(np.flatnonzero(~usable)[0])
            cell = self.cells[row][place]
            hint = " (write a point: 0.5, and no thousands separator)" if "," in cell else ""
            if self._ambiguous and _SIGNED.fullmatch(cell):
                hint = " (decimals or thousands? separate cells by commas, write a point: 0.5)"
            kind = f"number within ±{LARGEST:g}" if np.isfinite(values[row]) else "finite number"
            raise self._error(self.lines[row], f"expected a {kind}, got {cell!r}{hint}", place)
        return values

    def _tags(self, place: int) -> list[int | str | None]:
        return [
            self._tag(cells[place], number, place)
            for number, cells in zip(self.lines, self.cells, strict=True)
        ]

    def _tag(self, cell: str, line: int, place: int) -> int | str | None:
        """The name of a landmark: 11 of 11.0, which pandas writes; text; None if unknown."""
        if cell.lower() in MISSING:
            return None
        digits = cell.isascii() and cell.isdigit()
        value = self._value(cell)
        if value == -1:
            return None
        if digits and len(cell) > DIGITS:
            raise self._error(line, f"expected at most {DIGITS} digits, got {len(cell)}", place)
        if digits:
            return int(cell)
        numeric = not math.isnan(value) or _SIGNED.fullmatch(cell)
        if numeric and not (value.is_integer() and 0 <= value < 2**53):
            reason = f"expected a whole number >= 0, or nothing if unknown, or a name, got {cell!r}"
            raise self._error(line, reason, place)
        if not numeric and not (cell.isprintable() and len(cell) <= _MAX_NAME):
            reason = (
                f"expected a name of at most {_MAX_NAME} characters in one line, got {cell!r:.80}"
            )
            raise self._error(line, reason, place)
        return int(value) if numeric else cell

    def _column(self, place: int) -> str:
        return f"column {place + 1} ({self.header[place]})"

    def _error(self, line: int, reason: str, place: int | None = None) -> InvalidFile:
        column = None if place is None else self._column(place)
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


ODOMETRY, MEASUREMENTS = "odometry.csv", "measurements.csv"

_MAX_SHARE_OF_LARGEST = 0.01
"""Share of ranges that equal the largest one, above which a note asks for `max_range`: of a
continuous measurement hardly two are equal."""


def table(folder: str | Path, *, fitted: bool = True) -> Dataset:
    """The data set in the CSV files of a folder.

    `odometry.csv` has the columns `t [s]` and the controls of a motion model without Δt, as
    `v [m/s],omega [rad/s]`, or a path of poses, `x [m],y [m],theta [rad]`. `measurements.csv` has
    `t [s]`, `tag` (a whole number or a name; empty if the landmark is unknown) and the measurements
    of a sensor, as `range [m],bearing [rad]`. Optional are `truth.csv` (t, x, y, theta; empty or
    NaN where unknown), `landmarks.csv` (tag, x, y of every tag) and `dataset.toml`:

        [motion]
        model = "unicycle"
        noise = [0.02, 0.01]        # standard deviations, in the order of the model
        [sensor]
        model = "range_bearing"
        noise = [0.05, 0.02]
        mount = [0.1, 0.0, 0.0]     # and further arguments of the model
        delay = 0.05                # of measurements after odometry
        max_range = 5.6             # from which on a range says nothing
        [filter]
        gate = 0.999                # probability
        start = [0.0, 0.0, 0.0]     # in the frame of truth and landmarks
        start_noise = [0.0, 0.0, 0.0]
        capacity = 50
        associate = "nearest"
        update = "sequential"
        spacing = 3.0               # least time between used measurements of a landmark

    Systematic errors are keys of [motion], `scale`, `wheels` and `heading` of `motion.Corrected`,
    and of [sensor], `range` and `axis` of `sensors.Corrected` and `across` of
    `sensors.RangeBearingNoise`. [calibration] has the covariance in which they are known. Missing
    settings have defaults, listed in `Dataset.assumed`. The log is `Log.from_records`. The
    noise of the motion is that of a line of odometry; a row that is shorter or longer has white
    noise of the same density. The true pose of a row is interpolated between two lines of the
    truth, but not in a gap, an interval above ten times their median, nor over a jump, nor where a
    tracker repeats a pose beside a jump: there, and before and after the truth, it is unknown
    (`Dataset.true_at`). The start is that of the truth if it covers the
    first row; then all is in one frame. Other columns are not used, and listed. A CSV file may be
    packed by gzip, as `truth.csv.gz`; of both the plain one is read.

    Args:
        folder: the folder of the files.
        fitted: whether numbers of `fit.toml`, if there is one, replace those of `dataset.toml`.
    Raises:
        ValueError: `path:line: column: what was expected` on a header without a column or a unit, a
            cell that is not a finite number, a tag that is a number and not whole, times that go
            back (or repeat, but for measurements), a line with another number of cells, no lines;
            `path: [section] key: …` on settings; on a measured tag that `landmarks.csv` lacks; and
            where no measurement is left.
    """
    folder = Path(folder)
    if not folder.is_dir():
        problem = "is a file" if folder.exists() else "does not exist"
        raise ValueError(
            f"{folder} {problem}: expected a folder with {ODOMETRY} and {MEASUREMENTS}"
        )
    for name, columns in ((ODOMETRY, "controls of the motion"), (MEASUREMENTS, "measurements")):
        if not any((folder / file).is_file() for file in (name, f"{name}.gz")):
            raise ValueError(
                f"{folder}: expected a file {name}, with columns '{TIME}' and the {columns}, as "
                "docs/guide/own_data.md shows"
            )
    settings = TableSettings(folder / "dataset.toml", fitted)
    odometry_file = CsvTable(folder / ODOMETRY)
    measurement_file = CsvTable(folder / MEASUREMENTS)
    clock = odometry_file.table((TIME,), "the time").columns[TIME]
    interval = float(np.median(np.diff(clock))) if len(clock) > 1 else 1.0
    # Times that go back, or a median of 0, are refused when the tables are aligned.
    by_motion = settings.motion(odometry_file.header, abs(interval) or 1.0)
    by_sensor = settings.sensor(measurement_file.header)
    motion, sensor = by_motion.model, by_sensor.model
    of_log = settings.read("sensor", "delay", "max_range", "outliers")
    of_log |= settings.read("filter", "start", "spacing")
    delay, max_range = of_log["delay"], of_log["max_range"]
    odometry_names = (TIME, *tables.odometry_columns(motion.controls, odometry_file.header))
    measurement_names = tables.measurement_columns(sensor.measurements, sensor.landmark)
    odometry = odometry_file.table(odometry_names, f"of the motion model {motion.name}")
    measurements = measurement_file.table(measurement_names, f"of the sensor {sensor.name}")
    measurements.columns[TIME] = measurements.columns[TIME] - delay
    notes = [file.dialect for file in (odometry_file, measurement_file) if file.dialect]
    notes += [
        f"column {column!r} of {file.path.name} is not used"
        for file, names in ((odometry_file, odometry_names), (measurement_file, measurement_names))
        for column in file.unused(names)
    ]
    from_poses = odometry_names[1:] == POSE
    notes += _odometry_notes(odometry, from_poses)
    notes += [
        f"{sign} in the header"
        for part in (odometry, measurements)
        for sign in tables.wrong_units(part)
    ]
    if "range [m]" in measurements.columns and not np.isfinite(max_range):
        ranges = measurements.columns["range [m]"]
        largest = int((ranges == ranges.max()).sum())
        if largest > max(10, _MAX_SHARE_OF_LARGEST * len(ranges)):
            notes.append(
                f"{largest:,} ranges are {ranges.max():.6g} m, the largest: if the sensor writes "
                "it where it met nothing, set [sensor] max_range"
            )
    survey = _survey(folder / "landmarks.csv", notes)
    seen = tables.Seen(
        measurements, sensor.measurements, max_range=max_range, spacing=of_log["spacing"]
    )
    rows, tags, dropped = tables.align_tables(
        odometry,
        [seen],
        motion.controls,
        tuple(survey or ()),
    )
    if not rows.valid.any():
        raise none_left(f"{measurement_file.path}:{measurement_file.lines[0]}", dropped)
    for row, tag in enumerate(measurements.tags or ()):
        # A tag that is not in the log is measured outside of the odometry alone, and counted.
        if survey is not None and tag in tags and tag not in survey:
            raise ValueError(
                f"{measurements.at(row, TAG)}: expected a tag of landmarks.csv, got {tag}"
            )
    true_path, true_at, truth_notes = _truth(folder / "truth.csv", rows.time)
    notes += truth_notes
    start, one_frame = of_log["start"], True
    if start is None:
        one_frame = true_at is not None and bool(true_at[0])
        start = true_path[0] if true_path is not None and one_frame else np.zeros(3)
        shown = [float(f"{value:.6g}") for value in start]
        notes.append(f"[filter] start = {shown}" + ", the truth at the first row" * one_frame)
    if sensor.name in UNMEASURED and survey is not None and one_frame:
        notes.append(
            f"{', '.join(sensor.measurements)} alone: a filter starts each landmark from the prior "
            "[sensor] free; --filters localization takes those of landmarks.csv, and needs none"
        )
    further, further_cov = settings.further_start
    apart = np.zeros((3, len(further)))
    unknown = None in (measurements.tags or ())
    capacity, start_cov, filter_options = settings.filter(len(tags), unknown)
    named = settings.read("", "name", "source", folder=folder.resolve().name)
    log = Log.from_rows(rows)
    adjustable = _with_parameters(log, rows.time, by_motion, by_sensor, delay)
    return Dataset(
        name=named["name"],
        log=log,
        time=rows.time,
        motion=motion,
        sensor=sensor,
        tags=tags,
        pose=np.concatenate([start, further]),
        pose_cov=np.block([[start_cov, apart], [apart.T, further_cov]]),
        filter_options=filter_options,
        landmarks=None if survey is None else np.array([survey[tag] for tag in tags]),
        true_path=true_path,
        true_at=true_at,
        one_frame=one_frame,
        slots=capacity,
        adjustable=adjustable._replace(cov=settings.calibration_cov(adjustable.parameters)),
        dropped=dropped,
        assumed=tuple(settings.assumed + notes),
        default_noises=settings.default_noises,
        spurious=_spurious(of_log["outliers"], measurements),
        source=named["source"],
    )


def _spurious(outliers: float, measurements: Columns[int | str]) -> Spurious | None:
    """Outliers of that share, within the largest distance that was measured; None of a share 0."""
    if not outliers:
        return None
    distances = [
        np.abs(values).max()
        for name, values in measurements.columns.items()
        if split_unit(name)[1] == "m"
    ]
    return Spurious(outliers=outliers, reach=max(distances, default=1.0))


def _odometry_notes(odometry: Columns[int | str], from_poses: bool) -> list[str]:
    """Replace jumps of the path of odometry, if it is one; notes on jumps and gaps.

    from_poses: whether the controls are increments between poses.
    """
    notes = []
    if jump := tables.replace_jumps(odometry):
        notes.append(jump)
    if gap := _longest_gap(odometry):
        rule = (
            "no pose is interpolated over" if from_poses else "the odometry is taken to hold over"
        )
        notes.append(f"{gap}; {rule} it")
    return notes


def _with_parameters(
    log: Log,
    time: np.ndarray,
    motion: Parametric[Motion],
    sensor: Parametric[Sensor],
    delay: float,
) -> Adjustable:
    """Log and models as functions of the parameters of both, and of the delay if there is one."""
    count, size = len(motion.parameters), len(motion.parameters) + len(sensor.parameters)
    parameters = motion.parameters + sensor.parameters
    controls = motion.model.controls
    # Without Δt among the controls a row cannot be divided at a delayed measurement.
    if controls[-1:] == (tables.INTERVAL,):
        parameters += (Parameter("delay [s]", delay, "delay", ("sensor", "delay")),)

    def at(p: jax.Array) -> tuple[Log, Motion, Sensor]:
        shifted = log if p.shape[0] == size else delayed(log, time, controls, p[size] - delay)
        return shifted, motion.at(p[:count]), sensor.at(p[count:size])

    return Adjustable(parameters, at)


def _longest_gap(table: Columns[int | str]) -> str:
    """The place and the length of the longest gap between lines; empty without one."""
    clock = table.columns[TIME]
    if not is_gap(clock).any():
        return ""
    steps = np.diff(clock)
    k = int(np.argmax(steps))
    return (
        f"{table.at(k + 1, TIME)}: {steps[k]:.6g} s since the line before, the median is "
        f"{np.median(steps):.6g} s"
    )


def _survey(path: Path, notes: list[str]) -> dict[int | str, tuple[float, float]] | None:
    """The position of each tag, and notes added; None without a file."""
    if stored_file(path) is None:
        return None
    file = CsvTable(path)
    notes += [file.dialect] if file.dialect else []
    columns = file.table((TAG, *POSE[:2]), "of landmarks")
    survey: dict[int | str, tuple[float, float]] = {}
    for row, tag in enumerate(columns.tags or ()):
        if tag is None or tag in survey:
            got = "nothing" if tag is None else f"{tag} again"
            raise ValueError(
                f"{columns.at(row, TAG)}: expected a tag that no other line has, got {got}"
            )
        survey[tag] = tuple(columns.values(POSE[:2])[row])
    return survey


def _truth(path: Path, time: np.ndarray) -> tuple[np.ndarray | None, np.ndarray | None, list[str]]:
    """The true pose at each row (T, 3), a mask of the rows that have one (T,), and notes."""
    if stored_file(path) is None:
        return None, None, []
    file = CsvTable(path)
    columns = file.table((TIME, *POSE), "of a true path", optional=POSE)
    tables.check_times(columns, strict=True)
    clock, pose = columns.columns[TIME], columns.values(POSE)
    if time[0] > clock[-1] or time[-1] < clock[0]:
        raise ValueError(
            f"{columns.at(0, TIME)}: expected times within those of the log, {time[0]:.12g} to "
            f"{time[-1]:.12g}, got {clock[0]:.12g} to {clock[-1]:.12g}"
        )
    true_path, true_at = known_poses(clock, pose, time)
    notes = [file.dialect] if file.dialect else []
    if lost := int((~np.isfinite(pose).all(axis=1)).sum()):
        notes.append(f"{file.path.name}: {lost:,} of {len(pose):,} lines have no pose")
    if gap := _longest_gap(columns):
        notes.append(f"{gap}: no pose is interpolated over it")
    jump, repeated = true_path_faults(clock, pose)
    if jump.any():
        k = int(np.argmax(jump))
        length, turn = step_sizes(pose[k - 1 : k + 1])[1]
        notes.append(
            f"{columns.at(k, POSE[0])}: a jump by {length:.3g} m and {np.rad2deg(turn):.3g}° in "
            f"{clock[k] - clock[k - 1]:.3g} s is no motion, {int(jump.sum()):,} in all: no pose is "
            "interpolated over it"
            + f"; {int(repeated.sum()):,} lines beside jumps repeat a pose and are not used"
            * bool(repeated.any())
        )
    if unknown := int((~true_at).sum()):
        notes.append(
            f"{unknown:,} of {len(time):,} rows have no true pose: before the first or after the "
            f"last line of {file.path.name}, in a gap or a jump of it, or beside a line without a "
            "pose"
        )
    if are_headings_in_degrees(pose):
        notes.append(f"{file.path.name}: {tables.DEGREES_OF_PATH} in the header")
    return true_path, true_at, notes
