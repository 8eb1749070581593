"""The UTIAS multi-robot cooperative localization and mapping data (MRCLAM)."""

from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxslam.datasets.dataset import Dataset, make_log
from jaxslam.datasets.lines import TextFile
from jaxslam.motion import unicycle
from jaxslam.noise import NoiseCov
from jaxslam.sensors import Part, range_bearing, suite
from jaxslam.team import Robot, motion_of, sensors_of
from jaxslam.types import Log, Scan

SOURCE = (
    "K. Y. K. Leung, Y. Halpern, T. D. Barfoot, H. H. T. Liu, The UTIAS multi-robot cooperative "
    "localization and mapping dataset, International Journal of Robotics Research 30(8), 2011"
)
ROBOTS = range(1, 6)
"""Subjects 1 to 5 are the robots; they carry barcodes like the landmarks, 6 to 20."""
ODOMETRY_DENSITY = (0.01**2, 0.05**2)
"""Variance of travel [m²/s] and heading [rad²/s] gained in a second."""
MEASUREMENT_COV = np.diag([0.15, 0.01]) ** 2
_DROPS = ("robot sightings", "unknown barcodes", "repeated in a scan")
EXCHANGED = {11: [3.15071999, 2.38294871], 17: [0.03596156, -2.84396626]}
"""Two subjects that stand in each other's place in the survey of data set 1, as the file has them:
the distance of either from a landmark of the same scan differs by metres from the survey, and by
centimetres once the two are exchanged."""


def mrclam(
    folder: str | Path,
    robot: int = 1,
    *,
    odometry_cov: NoiseCov | None = None,
    measurement_cov: NoiseCov = MEASUREMENT_COV,
    errata: bool = True,
) -> Dataset:
    """Read `Robot{n}_Odometry.dat`: t v ω, and `Robot{n}_Measurement.dat`: t barcode range bearing.

    The log has a row at every time that occurs in either file. Its control is (v, ω, Δt): the
    velocity of the latest odometry line before the row, held since the row before; zero until the
    first line. So Δt = 0 in the first row alone, and of odometry lines with equal times the last
    one holds. The measurements of one time form one scan. `Barcodes.dat` says whose barcode it is;
    sightings of robots, barcodes it does not list and repetitions within a scan are dropped and
    counted. Tags follow the subject numbers; `Landmark_Groundtruth.dat` is the survey.

    The default noise is chosen on robots 1 to 3 of data set 1. Bearings of one scan agree with the
    survey to 0.005 rad, whatever the pose; 0.01 leaves room for time stamps. Ranges are off it by
    0.16 to 0.19 m, but alike for seconds, so that innovations see 0.11 m; 0.15 is between. With
    odometry noise of 0.01 m/√s and 0.05 rad/√s, NIS/dof is then 0.78, 1.22 and 0.92. Since the
    errors of ranges persist, the map's covariance is too small whatever the choice. No gate: one at
    5 σ moves the maps by millimetres.

    Source: Leung, Halpern, Barfoot, Liu, International Journal of Robotics Research 30(8), 2011.

    Args:
        folder: where the files of one data set are.
        robot: which robot, 1 to 5.
        odometry_cov: (2, 2) covariance of (v, ω) over a row's Δt, or a function of (pose, u).
        measurement_cov: (2, 2) covariance of (range, bearing), or a function of z.
        errata: exchange the positions of subjects 11 and 17 if they are those of data set 1, see
            `EXCHANGED`; `Dataset.corrections` then says so. False takes the survey as it is.
    Raises:
        ValueError: `path:line: reason` on a malformed line, a time that goes backwards, a negative
            range, or a subject without survey; and on a robot other than 1 to 5.
    """
    if type(robot) is not int or robot not in ROBOTS:
        raise ValueError(f"mrclam: expected a robot from 1 to 5, got {robot!r}")
    folder = Path(folder)
    subject_of, names = _read_barcodes(TextFile(folder / "Barcodes.dat", "#"))
    points = _read_survey(TextFile(folder / "Landmark_Groundtruth.dat", "#"), names)
    corrections = _correct(points) if errata else ()
    odometry, seen = _read_robot(folder, robot)
    time = np.unique(np.concatenate([odometry[:, 0], seen[:, 0]]))
    row, tag, kept, dropped = _associate(seen, time, subject_of, names)
    return Dataset(
        name=f"mrclam robot {robot}",
        log=make_log(_hold(odometry, time), row, tag, seen[kept, 2:]),
        time=time,
        motion=unicycle(white_noise(*ODOMETRY_DENSITY) if odometry_cov is None else odometry_cov),
        sensor=range_bearing(measurement_cov),
        tags=names,
        filter_options={"update": "sequential"},
        landmarks=np.array([points[name] for name in names]),
        dropped=dropped,
        corrections=corrections,
        source=SOURCE,
    )


def mrclam_team(
    folder: str | Path,
    robots: tuple[int, ...] = (1, 2, 3),
    *,
    odometry_cov: NoiseCov | None = None,
    measurement_cov: NoiseCov = MEASUREMENT_COV,
    sighting_cov: NoiseCov | None = None,
    errata: bool = True,
) -> Dataset:
    """The data of several robots on one clock, with their sightings of each other.

    The log has a row at every time that occurs in a file of any of them, and at each row all of
    them move, as in `mrclam`: (v, ω, Δt) for each. Places of a scan are by robot, those for
    landmarks before those for robots; tags N, N + 1, … are the robots in the order asked for. The
    first robot's start is the map's frame. Where the others start, the files do not say: they have
    no start, and have to find themselves. Sightings fit much worse than landmarks do: over the
    first half of data set 1, robots 1 to 3, they are off by 0.24 m and 0.078 rad (NIS/dof 5.7 with
    the noise of landmarks), so a `sighting_cov` of their own is advisable. Sightings of
    robots not asked for are dropped and counted; otherwise as `mrclam`.

        data = mrclam_team(folder)
        filter = team_slam(data.robots, data.capacity)

    Args:
        folder: where the files of one data set are.
        robots: which, each from 1 to 5, none twice.
        odometry_cov, measurement_cov, errata: as for `mrclam`.
        sighting_cov: (2, 2) covariance of (range, bearing) of another robot, or a function of z;
            default measurement_cov.
    Raises:
        ValueError: as `mrclam`, and unless robots are different numbers from 1 to 5.
    """
    asked = tuple(robots)
    good = all(type(robot) is int and robot in ROBOTS for robot in asked)
    if not asked or not good or len(set(asked)) != len(asked):
        raise ValueError(f"mrclam_team: expected different robots from 1 to 5, got {robots!r}")
    folder = Path(folder)
    subject_of, names = _read_barcodes(TextFile(folder / "Barcodes.dat", "#"))
    points = _read_survey(TextFile(folder / "Landmark_Groundtruth.dat", "#"), names)
    corrections = _correct(points) if errata else ()
    files = [_read_robot(folder, robot) for robot in asked]
    time = np.unique(np.concatenate([table[:, 0] for pair in files for table in pair]))
    eye = range_bearing(measurement_cov)
    sight = eye if sighting_cov is None else range_bearing(sighting_cov)
    model = unicycle(white_noise(*ODOMETRY_DENSITY) if odometry_cov is None else odometry_cov)
    team, scans, controls, dropped = [], [], [], dict.fromkeys(_DROPS, 0)
    for odometry, seen in files:
        row, tag, kept, lost = _associate(seen, time, subject_of, names + asked)
        dropped = {why: dropped[why] + lost[why] for why in dropped}
        tags, rows, held = np.array(tag), np.array(row), _hold(odometry, time)
        controls.append(held)
        parts = []
        for robots_seen in (False, True):
            mine = (tags >= len(names)) == robots_seen
            if mine.any():
                scan = make_log(held, rows[mine], tags[mine], seen[kept, 2:][mine]).scan
                sees: Literal["landmarks", "robots"] = "robots" if robots_seen else "landmarks"
                sensor = sight if robots_seen else eye
                parts.append(Part(sensor, scan.tag.shape[1], sees=sees))
                scans.append(scan)
        team.append(Robot(model, suite(*parts)))
    control: Any = np.concatenate(controls, axis=1)
    together: list[Any] = [np.concatenate(leaves, axis=1) for leaves in zip(*scans, strict=True)]
    return Dataset(
        name=f"mrclam robots {', '.join(map(str, asked))}",
        log=Log(control, Scan(*together)),
        time=time,
        motion=motion_of(team, 0),
        sensor=sensors_of(team, 0),
        tags=names,
        filter_options={"update": "sequential"},
        landmarks=np.array([points[name] for name in names]),
        dropped=dropped,
        corrections=corrections,
        source=SOURCE,
        robots=tuple(team),
    )


def white_noise(v: float, omega: float) -> NoiseCov:
    """Noise of (v, ω) whose integral does not depend on how time is cut: covariance density/Δt.

    v [m²/s], omega [rad²/s]: the variance of travel and heading gained in a second. An interval of
    zero, over which nothing moves, gets zero.
    """

    def noise_cov(pose: jax.Array, u: jax.Array) -> jax.Array:
        moving = u[2] > 0
        rate = jnp.where(moving, 1 / jnp.where(moving, u[2], 1.0), 0.0)
        return rate * jnp.diag(jnp.stack([jnp.asarray(v, u.dtype), jnp.asarray(omega, u.dtype)]))

    return noise_cov


def _read_robot(folder: Path, robot: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Odometry (·, 3) and measurements (·, 4) of one robot, with their times."""
    odometry = _read_in_time(
        TextFile(folder / f"Robot{robot}_Odometry.dat", "#"), ("time", "v", "omega")
    )
    seen = _read_in_time(
        TextFile(folder / f"Robot{robot}_Measurement.dat", "#"),
        ("time", "barcode", "range", "bearing"),
    )
    return odometry, seen


def _hold(odometry: NDArray[np.float64], time: NDArray[np.float64]) -> NDArray[np.float64]:
    """Controls (T, 3): the velocity in force at the time before, and the interval since."""
    start = np.concatenate([time[:1], time[:-1]])
    latest = np.searchsorted(odometry[:, 0], start, side="right") - 1
    velocity = np.where((latest >= 0)[:, None], odometry[np.maximum(latest, 0), 1:], 0.0)
    velocity[0] = 0.0
    return np.column_stack([velocity, time - start])


def _associate(
    seen: NDArray[np.float64],
    time: NDArray[np.float64],
    subject_of: dict[int, int],
    names: tuple[int, ...],
) -> tuple[list[int], list[int], list[int], dict[str, int]]:
    """Row, tag and index of the measurements kept, and how many were dropped why.

    names: the subjects asked for, landmarks first; their tags are their places in the list.
    """
    tag_of = {name: tag for tag, name in enumerate(names)}
    dropped = dict.fromkeys(_DROPS, 0)
    kept: dict[tuple[int, int], int] = {}
    row = np.searchsorted(time, seen[:, 0])
    for k, barcode in enumerate(seen[:, 1]):
        subject = subject_of.get(int(barcode))
        if subject is None:
            dropped["unknown barcodes"] += 1
        elif subject not in tag_of:
            dropped["robot sightings"] += 1
        elif (int(row[k]), tag_of[subject]) in kept:
            dropped["repeated in a scan"] += 1
        else:
            kept[int(row[k]), tag_of[subject]] = k
    return [r for r, _ in kept], [t for _, t in kept], list(kept.values()), dropped


def _read_in_time(file: TextFile, names: tuple[str, ...]) -> NDArray[np.float64]:
    """A table whose first column never decreases."""
    table: list[list[float]] = []
    for line, fields in file:
        values = file.numbers(line, fields, names)
        if table and values[0] < table[-1][0]:
            raise file.error(line, f"time goes back from {table[-1][0]} to {values[0]}")
        if names[1] == "barcode":
            file.identity(line, fields[1], "barcode")
            if values[2] < 0:
                raise file.error(line, f"the range {values[2]} is negative")
        table.append(values)
    if not table:
        raise file.end_error("no data in the file")
    return np.array(table)


def _read_barcodes(file: TextFile) -> tuple[dict[int, int], tuple[int, ...]]:
    """The subject of each barcode, and the landmarks among the subjects in rising order."""
    subject_of: dict[int, int] = {}
    for line, fields in file:
        file.expect(line, fields, ("subject", "barcode"))
        subject = file.identity(line, fields[0], "subject")
        barcode = file.identity(line, fields[1], "barcode")
        if barcode in subject_of or subject in subject_of.values():
            raise file.error(line, f"subject {subject} or barcode {barcode} occurs twice")
        subject_of[barcode] = subject
    names = tuple(sorted(set(subject_of.values()) - set(ROBOTS)))
    if not names:
        raise file.end_error("no landmark in the file")
    return subject_of, names


def _read_survey(file: TextFile, names: tuple[int, ...]) -> dict[int, list[float]]:
    """The position of every landmark."""
    points: dict[int, list[float]] = {}
    for line, fields in file:
        columns = ("subject", "x", "y", "sigma_x", "sigma_y")
        _, x, y, _, _ = file.numbers(line, fields, columns)
        subject = file.identity(line, fields[0], "subject")
        if subject not in names:
            raise file.error(line, f"subject {subject} is no landmark in Barcodes.dat")
        if subject in points:
            raise file.error(line, f"subject {subject} occurs twice")
        points[subject] = [x, y]
    missing = [name for name in names if name not in points]
    if missing:
        raise file.end_error(f"no position of subject {missing[0]} in the file")
    return points


def _correct(points: dict[int, list[float]]) -> tuple[str, ...]:
    """Undo the exchange of data set 1, if this is its survey; what was done, in words."""
    if any(points.get(subject) != position for subject, position in EXCHANGED.items()):
        return ()
    one, other = EXCHANGED
    points[one], points[other] = points[other], points[one]
    return (f"the surveyed positions of subjects {one} and {other} were exchanged",)
