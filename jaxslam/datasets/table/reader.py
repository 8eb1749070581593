"""Reader of your own data: CSV files with units in the header, and a file of settings."""

from pathlib import Path

import numpy as np

from jaxslam.core.logs import tables
from jaxslam.core.logs.streams import interpolate_poses
from jaxslam.core.logs.tables import POSE, TAG, TIME
from jaxslam.core.protocols import Motion, Sensor
from jaxslam.core.types import Log
from jaxslam.datasets.dataset import Adjustable, Dataset
from jaxslam.datasets.lines import stored
from jaxslam.datasets.table.csv_table import CsvTable
from jaxslam.datasets.table.models import Parametric
from jaxslam.datasets.table.settings import TableSettings

ODOMETRY, MEASUREMENTS = "odometry.csv", "measurements.csv"

_GAP = 10
"""An interval of odometry above so many medians is noted."""


def table(folder: str | Path) -> Dataset:
    """The data set in the CSV files of a folder.

    `odometry.csv` has the columns `t [s]` and the controls of a motion model without Δt, as
    `v [m/s],omega [rad/s]`, or a path of poses, `x [m],y [m],theta [rad]`. `measurements.csv` has
    `t [s]`, `tag` (empty where the landmark is unknown) and what a sensor measures, as
    `range [m],bearing [rad]`. Optional are `truth.csv` (t, x, y, theta), `landmarks.csv` (tag, x, y
    of every tag) and `dataset.toml`:

        [motion]
        model = "unicycle"
        noise = [0.02, 0.01]        # standard deviations, in the order of the model
        [sensor]
        model = "range_bearing"
        noise = [0.05, 0.02]
        mount = [0.1, 0.0, 0.0]     # and further arguments of the model
        [filter]
        gate = 0.999                # probability
        start = [0.0, 0.0, 0.0]     # in the frame of truth and landmarks
        start_noise = [0.0, 0.0, 0.0]
        capacity = 50
        associate = "nearest"
        update = "sequential"

    What is left out has a default, listed in `Dataset.assumed`. The log is `Log.from_records`. The
    noise of the motion is that of a line of odometry; a row that is shorter or longer has white
    noise of the same density. The start is that of the truth, where this covers the first row; then
    all is in one frame. Other columns are not used, and listed. A CSV file may be packed by gzip,
    as `truth.csv.gz`; where both are there the plain one is read.

    Args:
        folder: where the files are.
    Raises:
        ValueError: `path:line: column: what was expected` on a header without a column or a unit, a
            cell that is no finite number, a tag that is no whole number, times that go back (or
            repeat, but for measurements), a line with another number of cells, no lines; `path:
            [section] key: …` on settings; and on a measured tag that `landmarks.csv` lacks.
    """
    folder = Path(folder)
    if not folder.is_dir():
        found = "is a file" if folder.exists() else "is not there"
        raise ValueError(f"{folder} {found}: expected a folder with {ODOMETRY} and {MEASUREMENTS}")
    for name, columns in ((ODOMETRY, "controls of the motion"), (MEASUREMENTS, "measurements")):
        if not any((folder / file).is_file() for file in (name, f"{name}.gz")):
            raise ValueError(
                f"{folder}: expected a file {name}, with columns '{TIME}' and the {columns}, as "
                "docs/guide/own_data.md shows"
            )
    settings = TableSettings(folder / "dataset.toml")
    odometry_file = CsvTable(folder / ODOMETRY)
    seen_file = CsvTable(folder / MEASUREMENTS)
    clock = odometry_file.table((TIME,), "the time").columns[TIME]
    interval = float(np.median(np.diff(clock))) if len(clock) > 1 else 1.0
    by_motion = settings.motion(odometry_file.header, abs(interval) or 1.0)
    by_sensor = settings.sensor(seen_file.header)
    motion, sensor = by_motion.made(), by_sensor.made()
    moved = (TIME, *tables.odometry_columns(motion.controls, odometry_file.header))
    measured = tables.measurement_columns(sensor.measurements, sensor.landmark)
    odometry = odometry_file.table(moved, f"of the motion model {motion.name}")
    seen = seen_file.table(measured, f"of the sensor {sensor.name}")
    notes = [
        f"column {column!r} of {file.path.name} is not used"
        for file, wanted in ((odometry_file, moved), (seen_file, measured))
        for column in file.unused(wanted)
    ]
    if len(clock) > 2 and (gaps := np.diff(clock)).max() > _GAP * np.median(gaps):
        k = int(np.argmax(gaps))
        notes.append(
            f"{odometry.at(k + 1, TIME)}: {gaps[k]:.6g} s since the line before, the median is "
            f"{np.median(gaps):.6g} s; the odometry is taken to hold for so long"
        )
    survey = _survey(folder / "landmarks.csv")
    rows, tags, dropped = tables.align_tables(
        odometry, [tables.Seen(seen, sensor.measurements)], motion.controls, tuple(survey or ())
    )
    known = tags if survey is None else survey
    for row, tag in enumerate(seen.tags or ()):
        if tag is not None and tag not in known:
            raise ValueError(f"{seen.at(row, TAG)}: expected a tag of landmarks.csv, got {tag}")
    truth, covered = _truth(folder / "truth.csv", rows.time)
    start, one_frame = settings.start(), True
    if start is None:
        one_frame = covered is not None and bool(covered[0])
        start = truth[0] if truth is not None and one_frame else np.zeros(3)
        shown = [float(f"{value:.6g}") for value in start]
        notes.append(f"[filter] start = {shown}" + ", the truth at the first row" * one_frame)
    unknown = None in (seen.tags or ())
    capacity = settings.capacity(len(tags), unknown)
    return Dataset(
        name=settings.text("name", folder.resolve().name),
        log=Log.from_rows(rows),
        time=rows.time,
        motion=motion,
        sensor=sensor,
        tags=tags,
        pose=start,
        pose_cov=np.diag(settings.start_noise()) ** 2,
        filter_options=settings.filter_options(len(sensor.measurements), unknown),
        landmarks=None if survey is None else np.array([survey[tag] for tag in tags]),
        true_path=truth,
        true_at=covered,
        one_frame=one_frame,
        slots=capacity,
        adjustable=_adjustable(by_motion, by_sensor),
        dropped=dropped,
        assumed=tuple(settings.assumed + notes),
        source=settings.text("source", ""),
    )


def _adjustable(motion: Parametric[Motion], sensor: Parametric[Sensor]) -> Adjustable:
    """Both models by the deviations of both, one after the other."""
    count = len(motion.names)
    return Adjustable(
        names=tuple(f"motion {n}" for n in motion.names)
        + tuple(f"sensor {n}" for n in sensor.names),
        deviations=motion.deviations + sensor.deviations,
        mount=sensor.mount,
        models=lambda sigma, mount: (
            motion.make(sigma[:count], None),
            sensor.make(sigma[count:], mount),
        ),
    )


def _survey(path: Path) -> dict[int, tuple[float, float]] | None:
    """The position of each tag; None where there is no file."""
    if stored(path) is None:
        return None
    found = CsvTable(path).table((TAG, *POSE[:2]), "of landmarks")
    survey: dict[int, tuple[float, float]] = {}
    for row, tag in enumerate(found.tags or ()):
        if tag is None or tag in survey:
            got = "nothing" if tag is None else f"{tag} again"
            raise ValueError(f"{found.at(row, TAG)}: expected a tag of its own, got {got}")
        survey[tag] = tuple(found.values(POSE[:2])[row])
    return survey


def _truth(path: Path, time: np.ndarray) -> tuple[np.ndarray | None, np.ndarray | None]:
    """The true pose at each row (T, 3), and in which rows it is known (T,); None without a file."""
    if stored(path) is None:
        return None, None
    found = CsvTable(path).table((TIME, *POSE), "of a true path")
    tables.check_times(found, strict=True)
    clock = found.columns[TIME]
    covered = (time >= clock[0]) & (time <= clock[-1])
    if not covered.any():
        raise ValueError(
            f"{found.at(0, TIME)}: expected times within those of the log, {time[0]:.12g} to "
            f"{time[-1]:.12g}, got {clock[0]:.12g} to {clock[-1]:.12g}"
        )
    return interpolate_poses(clock, found.values(POSE), time), covered
