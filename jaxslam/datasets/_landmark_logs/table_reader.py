"""Reader of your data: CSV files with units in the header, and a file of settings."""

from pathlib import Path

import jax
import numpy as np

from jaxslam.calibration import delayed
from jaxslam.core._units import are_headings_in_degrees
from jaxslam.core.logs import _tables as tables
from jaxslam.core.logs._streams import is_gap, known_poses, true_path_faults
from jaxslam.core.logs._tables import POSE, TAG, TIME, Columns, split_unit
from jaxslam.core.protocols import Motion, Sensor
from jaxslam.core.types import Log
from jaxslam.datasets._account import Account
from jaxslam.datasets._csv import CsvTable
from jaxslam.datasets._dataset import Adjustable, Dataset, Parameter
from jaxslam.datasets._landmark_logs.table_models import Parametric
from jaxslam.datasets._landmark_logs.table_settings import UNMEASURED, TableSettings
from jaxslam.datasets._lines import stored_file
from jaxslam.math._odometry_jumps import step_sizes
from jaxslam.simulation.spurious import Spurious

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
    clock = odometry_file.columns((TIME,), "the time").columns[TIME]
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
    odometry = odometry_file.columns(odometry_names, f"of the motion model {motion.name}")
    measurements = measurement_file.columns(measurement_names, f"of the sensor {sensor.name}")
    measurements.columns[TIME] = measurements.columns[TIME] - delay
    account = Account()
    notes = account.corrections
    notes += [file.dialect for file in (odometry_file, measurement_file) if file.dialect]
    notes += [
        f"column {column!r} of {file.path.name} is not used"
        for file, names in ((odometry_file, odometry_names), (measurement_file, measurement_names))
        for column in file.unused(names)
    ]
    if jump := tables.replace_jumps(odometry):
        notes.append(jump)
    is_path = odometry_names[1:] == POSE
    rule = "no pose is interpolated over" if is_path else "the odometry is taken to hold over"
    _note_longest_gap(odometry, f"; {rule} it", account)
    notes += [
        f"{sign} in the header"
        for part in (odometry, measurements)
        for sign in tables.wrong_units(part)
    ]
    if "range [m]" in measurements.columns and not np.isfinite(max_range):
        ranges = measurements.columns["range [m]"]
        largest = int((ranges == ranges.max()).sum())
        account.correct(
            f"{largest:,} ranges are {ranges.max():.6g} m, the largest: if the sensor writes it "
            "where it met nothing, set [sensor] max_range",
            largest > max(10, _MAX_SHARE_OF_LARGEST * len(ranges)),
        )
    survey = _survey(folder / "landmarks.csv", account)
    seen = tables.Seen(
        measurements, sensor.measurements, max_range=max_range, spacing=of_log["spacing"]
    )
    rows, tags, dropped = tables.align_tables(
        odometry, [seen], motion.controls, tuple(survey or ())
    )
    account.dropped.update(dropped)
    if not rows.valid.any():
        raise account.none_left(measurement_file.path, measurement_file.lines[0])
    for row, tag in enumerate(measurements.tags or ()):
        # A tag that is not in the log is measured outside of the odometry alone, and counted.
        if survey is not None and tag in tags and tag not in survey:
            raise measurements.error(row, TAG, f"expected a tag of landmarks.csv, got {tag}")
    true_path, true_at = _truth(folder / "truth.csv", rows.time, account)
    start, one_frame = of_log["start"], True
    if start is None:
        one_frame = true_at is not None and bool(true_at[0])
        start = true_path[0] if true_path is not None and one_frame else np.zeros(3)
        shown = [float(f"{value:.6g}") for value in start]
        notes.append(f"[filter] start = {shown}" + ", the truth at the first row" * one_frame)
    account.correct(
        f"{', '.join(sensor.measurements)} alone: a filter starts each landmark from the prior "
        "[sensor] free; --filters localization takes those of landmarks.csv, and needs none",
        sensor.name in UNMEASURED and survey is not None and one_frame,
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


def _note_longest_gap(table: Columns[int | str], rule: str, account: Account) -> None:
    """Note the place and the length of the longest gap between lines, if there is one."""
    clock = table.columns[TIME]
    if is_gap(clock).any():
        steps = np.diff(clock)
        k = int(np.argmax(steps))
        text = f"{steps[k]:.6g} s since the line before, the median is {np.median(steps):.6g} s"
        account.correct(str(table.error(k + 1, TIME, text + rule)))


def _survey(path: Path, account: Account) -> dict[int | str, tuple[float, float]] | None:
    """The position of each tag; None without a file."""
    if stored_file(path) is None:
        return None
    file = CsvTable(path)
    account.correct(file.dialect, file.dialect)
    columns = file.columns((TAG, *POSE[:2]), "of landmarks")
    survey: dict[int | str, tuple[float, float]] = {}
    for row, tag in enumerate(columns.tags or ()):
        if tag is None or tag in survey:
            got = "nothing" if tag is None else f"{tag} again"
            raise columns.error(row, TAG, f"expected a tag that no other line has, got {got}")
        survey[tag] = tuple(columns.values(POSE[:2])[row])
    return survey


def _truth(
    path: Path, time: np.ndarray, account: Account
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """The true pose at each row (T, 3), and a mask of the rows that have one (T,)."""
    if stored_file(path) is None:
        return None, None
    file = CsvTable(path)
    columns = file.columns((TIME, *POSE), "of a true path", optional=POSE)
    tables.check_times(columns, strict=True)
    clock, pose = columns.columns[TIME], columns.values(POSE)
    if time[0] > clock[-1] or time[-1] < clock[0]:
        within = f"{time[0]:.12g} to {time[-1]:.12g}, got {clock[0]:.12g} to {clock[-1]:.12g}"
        raise columns.error(0, TIME, f"expected times within those of the log, {within}")
    true_path, true_at = known_poses(clock, pose, time)
    account.correct(file.dialect, file.dialect)
    lost = int((~np.isfinite(pose).all(axis=1)).sum())
    account.correct(f"{file.path.name}: {lost:,} of {len(pose):,} lines have no pose", lost)
    _note_longest_gap(columns, ": no pose is interpolated over it", account)
    jump, repeated = true_path_faults(clock, pose)
    if jump.any():
        k = int(np.argmax(jump))
        length, turn = step_sizes(pose[k - 1 : k + 1])[1]
        text = (
            f"a jump by {length:.3g} m and {np.rad2deg(turn):.3g}° in {clock[k] - clock[k - 1]:.3g}"
            f" s is no motion, {int(jump.sum()):,} in all: no pose is interpolated over it"
        )
        if repeated.any():
            text += f"; {int(repeated.sum()):,} lines beside jumps repeat a pose and are not used"
        account.correct(str(columns.error(k, POSE[0], text)))
    unknown = int((~true_at).sum())
    account.correct(
        f"{unknown:,} of {len(time):,} rows have no true pose: before the first or after the last "
        f"line of {file.path.name}, in a gap or a jump of it, or beside a line without a pose",
        unknown,
    )
    account.correct(
        f"{file.path.name}: {tables.DEGREES_OF_PATH} in the header", are_headings_in_degrees(pose)
    )
    return true_path, true_at
