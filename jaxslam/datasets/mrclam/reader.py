"""Reader of the UTIAS multi-robot cooperative localization and mapping data (MRCLAM)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple, TypedDict

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from jaxslam.datasets.dataset import Dataset
from jaxslam.datasets.mrclam.calibration import RobotCalibration, per_interval, recorded
from jaxslam.datasets.mrclam.files import ROBOTS, read_landmarks, read_robot, read_truth
from jaxslam.datasets.mrclam.truth import START_COV, cut_after, true_poses
from jaxslam.logs.streams import Rows, hold
from jaxslam.motion import unicycle
from jaxslam.noise import NoiseCov
from jaxslam.protocols import Motion, Sensor
from jaxslam.sensors import Part, range_bearing, suite
from jaxslam.sensors.mounting import NO_OFFSET
from jaxslam.team import Robot, motion_of, sensors_of
from jaxslam.types import Log

SOURCE = (
    "K. Y. K. Leung, Y. Halpern, T. D. Barfoot, H. H. T. Liu, The UTIAS multi-robot cooperative "
    "localization and mapping dataset, International Journal of Robotics Research 30(8), 2011"
)
ODOMETRY_DENSITY = (0.01**2, 0.05**2)
"""Variance of travel [m²/s] and heading [rad²/s] per second."""
MEASUREMENT_COV = np.diag([0.15, 0.01]) ** 2
_DROPS = ("robot sightings", "unknown barcodes", "repeated in a scan")


def mrclam(
    folder: str | Path,
    robot: int = 1,
    *,
    calibration: RobotCalibration | None = None,
    odometry_cov: NoiseCov | None = None,
    measurement_cov: NoiseCov | None = None,
    errata: bool = True,
) -> Dataset:
    """The data of one robot in the files of a folder, each `NAME.dat` or `NAME.dat.gz`.

    These are `Robot{n}_Odometry.dat` (t v ω), `Robot{n}_Measurement.dat` (t barcode range bearing),
    `Barcodes.dat` (the subject of each barcode), `Landmark_Groundtruth.dat` (the survey) and, where
    it is there, `Robot{n}_Groundtruth.dat` (t x y θ).

    The log has a row at every time that occurs in either of the first two. Its control is
    (v, ω, Δt): the velocity of the latest odometry line at or before the row before, and the time
    since that row; zero before the first odometry line. So Δt = 0 in the first row only, and of
    odometry lines with equal times the last one counts. Measurements of one time form one scan.
    Measurements of robots and of unknown barcodes, and repetitions within a scan, are dropped and
    counted. Tags follow the subject numbers.

    With a true path, odometry lines (0, 0) at the end of the file and after it are left out, but
    for the first (`Dataset.corrections` says how many). If the true pose is known in the first row,
    the robot starts there, with the covariance `mrclam_truth.START_COV`, and path, survey and map
    are in one frame.

    The default noise is chosen on robots 1 to 3 of data set 1. Bearings within a scan agree with
    the survey to 0.005 rad; 0.01 allows for errors of the time stamps. Ranges deviate by 0.16 to
    0.19 m, with errors that persist for seconds, so that innovations show 0.11 m; 0.15 is between.
    With odometry noise of 0.01 m/√s and 0.05 rad/√s, NIS/dof is then 0.78, 1.22 and 0.92. Since the
    errors of ranges persist, the map's covariance is too small for any choice. A `calibration`
    removes what causes them, see `MRCLAM_CALIBRATION`. There is no gate; a gate at 5 σ changes the
    maps by millimetres.

    Source: Leung, Halpern, Barfoot, Liu, International Journal of Robotics Research 30(8), 2011.

    Args:
        folder: where the files of one data set are.
        robot: number of the robot, 1 to 5.
        calibration: corrects odometry and ranges, and gives the noise. Default: as recorded.
        odometry_cov: (2, 2) covariance of (v, ω) over a row's Δt, or a function of (pose, u).
        measurement_cov: (2, 2) covariance of (range, bearing), or a function of z.
        errata: exchange the positions of subjects 11 and 17 if they are those of data set 1, see
            `mrclam_files.EXCHANGED`; `Dataset.corrections` then says so.
    Raises:
        ValueError: `path:line: reason` on a malformed line, a time that decreases, a negative
            range, or a subject without survey; and on a robot other than 1 to 5.
    """
    if type(robot) is not int or robot not in ROBOTS:
        raise ValueError(f"mrclam: expected a robot from 1 to 5, got {robot!r}")
    subject_of, names, points, corrections = read_landmarks(Path(folder), errata)
    own = _read(Path(folder), robot, calibration)
    time = np.unique(np.concatenate([own.odometry[:, 0], own.seen[:, 0]]))
    row, tag, kept, dropped = _associate(own.seen, time, subject_of, names)
    motion, sensor = _models(calibration, odometry_cov, measurement_cov)
    return Dataset(
        name=f"mrclam robot {robot}",
        log=_log(own.odometry, time, row, tag, own.seen[kept, 2:]),
        time=time,
        motion=motion,
        sensor=sensor,
        tags=names,
        filter_options={"update": "sequential"},
        landmarks=points,
        dropped=dropped,
        corrections=(*corrections, *own.corrections),
        source=SOURCE,
        **_truth([own], time),
    )


def mrclam_team(
    folder: str | Path,
    robots: tuple[int, ...] = (1, 2, 3),
    *,
    calibration: RobotCalibration | None = None,
    odometry_cov: NoiseCov | None = None,
    measurement_cov: NoiseCov | None = None,
    sighting_cov: NoiseCov | None = None,
    errata: bool = True,
) -> Dataset:
    """The data of several robots with common times, and their measurements of each other.

    The log has a row at every time that occurs in a file of any of the robots, with a control
    (v, ω, Δt) for each robot as in `mrclam`. Measurement slots of a scan are ordered by robot,
    those for landmarks before those for robots; tags N, N + 1, … are the robots in the given order.
    The first robot's start is the map's frame, from its true path where that is known. The others'
    starts are left to the filter. Measurements of robots are less accurate than those of landmarks:
    of robots 1 to 3 of data set 1, their innovations have standard deviations of 0.18 m and
    0.048 rad (NIS/dof 2.5 with the noise of landmarks; `python -m benchmarks --record --only
    team`), so a `sighting_cov` of their own is advisable. Measurements of other robots are dropped
    and counted; all else is as in `mrclam`.

        data = mrclam_team(folder)
        filter = team_slam(data.robots, data.capacity)

    Args:
        folder: where the files of one data set are.
        robots: their numbers, each from 1 to 5, none twice.
        calibration, odometry_cov, measurement_cov, errata: as for `mrclam`.
        sighting_cov: (2, 2) covariance of (range, bearing) of another robot, or a function of z;
            default measurement_cov.
    Raises:
        ValueError: as `mrclam`, and unless robots are different numbers from 1 to 5.
    """
    asked = tuple(robots)
    good = all(type(robot) is int and robot in ROBOTS for robot in asked)
    if not asked or not good or len(set(asked)) != len(asked):
        raise ValueError(f"mrclam_team: expected different robots from 1 to 5, got {robots!r}")
    subject_of, names, points, corrections = read_landmarks(Path(folder), errata)
    files = [_read(Path(folder), robot, calibration) for robot in asked]
    time = np.unique(np.concatenate([t[:, 0] for own in files for t in (own.odometry, own.seen)]))
    model, eye = _models(calibration, odometry_cov, measurement_cov)
    sight = eye if sighting_cov is None else _models(calibration, None, sighting_cov)[1]
    team, scans, controls, dropped = [], [], [], dict.fromkeys(_DROPS, 0)
    for own in files:
        row, tag, kept, lost = _associate(own.seen, time, subject_of, names + asked)
        dropped = {why: dropped[why] + lost[why] for why in dropped}
        tags, rows = np.array(tag), np.array(row)
        controls.append(hold(own.odometry[:, 0], own.odometry[:, 1:], time))
        parts = []
        for robots_seen in (False, True):
            mine = (tags >= len(names)) == robots_seen
            if mine.any():
                z = own.seen[kept, 2:][mine]
                scan = _log(own.odometry, time, rows[mine], tags[mine], z).scan
                sees: Literal["landmarks", "robots"] = "robots" if robots_seen else "landmarks"
                sensor = sight if robots_seen else eye
                parts.append(Part(sensor, scan.tag.shape[1], sees=sees))
                scans.append(scan)
        team.append(Robot(model, suite(*parts)))
    return Dataset(
        name=f"mrclam robots {', '.join(map(str, asked))}",
        log=Log.from_rows(
            Rows(
                time,
                np.concatenate(controls, axis=1),
                *(np.concatenate(parts, axis=1) for parts in zip(*scans, strict=True)),
            )
        ),
        time=time,
        motion=motion_of(team, 0),
        sensor=sensors_of(team, 0),
        tags=names,
        filter_options={"update": "sequential"},
        landmarks=points,
        dropped=dropped,
        corrections=(*corrections, *(line for own in files for line in own.corrections)),
        source=SOURCE,
        robots=tuple(team),
        **_truth(files, time),
    )


class _Recorded(NamedTuple):
    """What a robot's files hold, corrected where a calibration is given."""

    odometry: Float[np.ndarray, "K 3"]
    seen: Float[np.ndarray, "J 4"]
    truth: Float[np.ndarray, "G 4"] | None
    corrections: tuple[str, ...]


class _TrueFields(TypedDict, total=False):
    """The fields of a data set about true paths, and the start."""

    true_path: Float[np.ndarray, "T 3"]
    true_at: Bool[np.ndarray, "T"]
    true_paths: Float[np.ndarray, "R T 3"]
    true_paths_at: Bool[np.ndarray, "R T"]
    pose: Float[np.ndarray, "3"]
    pose_cov: Float[np.ndarray, "3 3"]
    one_frame: bool


def _read(folder: Path, robot: int, calibration: RobotCalibration | None) -> _Recorded:
    odometry, seen = read_robot(folder, robot)
    truth, corrections = read_truth(folder, robot), []
    if truth is not None:
        odometry, cut = cut_after(odometry, truth[-1, 0])
        if cut:
            corrections.append(
                f"{cut:,} odometry lines (0, 0) of robot {robot} after its true path were left out"
            )
    odometry, seen = recorded(odometry, seen, calibration)
    return _Recorded(odometry, seen, truth, tuple(corrections))


def _models(
    calibration: RobotCalibration | None,
    odometry_cov: NoiseCov | None,
    measurement_cov: NoiseCov | None,
) -> tuple[Motion, Sensor]:
    """The motion model and the sensor, with the noise that is given or the default."""
    default_moved: NoiseCov = white_noise(*ODOMETRY_DENSITY)
    default_seen: NoiseCov = MEASUREMENT_COV
    mount: ArrayLike = NO_OFFSET
    if calibration is not None:
        default_moved, default_seen = calibration.odometry_cov(), calibration.measurement_cov()
        mount = calibration.mount
    moved = default_moved if odometry_cov is None else odometry_cov
    seen = default_seen if measurement_cov is None else measurement_cov
    return unicycle(moved), range_bearing(seen, mount=mount)


def _truth(files: Sequence[_Recorded], time: Float[np.ndarray, "T"]) -> _TrueFields:
    """The true paths, and the start; nothing where no path is known."""
    if files[0].truth is None:
        return {}
    paths, known = true_poses(files[0].truth, time)
    found: _TrueFields = {"true_path": paths, "true_at": known}
    if len(files) > 1 and all(own.truth is not None for own in files):
        each = [true_poses(own.truth, time) for own in files if own.truth is not None]
        found["true_paths"] = np.stack([path for path, _ in each])
        found["true_paths_at"] = np.stack([at for _, at in each])
    if known[0]:
        found |= {"pose": paths[0], "pose_cov": START_COV, "one_frame": True}
    return found


def white_noise(v: float, omega: float) -> NoiseCov:
    """White noise of (v, ω) with covariance density/Δt, so that time steps can be divided.

    v [m²/s], omega [rad²/s]: the variance of travel and heading per second. Where Δt = 0 it is 0.
    """

    def noise_cov(pose: jax.Array, u: jax.Array) -> jax.Array:
        density = jnp.stack([jnp.asarray(v, u.dtype), jnp.asarray(omega, u.dtype)])
        return per_interval(density, u[2])

    return noise_cov


def _log(
    odometry: Float[np.ndarray, "K 3"],
    time: Float[np.ndarray, "T"],
    row: Int[np.ndarray, "J"] | list[int],
    tag: Int[np.ndarray, "J"] | list[int],
    z: Float[np.ndarray, "J Z"],
) -> Log:
    """The log of odometry (t, v, ω) and of measurements in some rows."""
    return Log.from_streams((odometry[:, 0], odometry[:, 1:]), (time[row], tag, z), hold, time)


def _associate(
    seen: Float[np.ndarray, "J 4"],
    time: Float[np.ndarray, "T"],
    subject_of: dict[int, int],
    names: tuple[int, ...],
) -> tuple[list[int], list[int], list[int], dict[str, int]]:
    """Row, tag and index of the measurements kept, and the number of dropped ones by reason.

    names: the subjects, landmarks first; their tags are their indices in the list.
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
