"""Reader of the UTIAS multi-robot cooperative localization and mapping data (MRCLAM)."""

from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxslam.datasets.dataset import Dataset
from jaxslam.datasets.mrclam_files import ROBOTS, read_landmarks, read_robot
from jaxslam.motion import unicycle
from jaxslam.noise import NoiseCov
from jaxslam.sensors import Part, range_bearing, suite
from jaxslam.streams import hold
from jaxslam.team import Robot, motion_of, sensors_of
from jaxslam.types import Log, Scan

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
    odometry_cov: NoiseCov | None = None,
    measurement_cov: NoiseCov = MEASUREMENT_COV,
    errata: bool = True,
) -> Dataset:
    """The data of one robot in the files of a folder.

    These are `Robot{n}_Odometry.dat` (t v ω), `Robot{n}_Measurement.dat` (t barcode range bearing),
    `Barcodes.dat` (the subject of each barcode) and `Landmark_Groundtruth.dat` (the survey).

    The log has a row at every time that occurs in either of the first two. Its control is
    (v, ω, Δt): the velocity of the latest odometry line at or before the row before, and the time
    since that row; zero before the first odometry line. So Δt = 0 in the first row only, and of
    odometry lines with equal times the last one counts. Measurements of one time form one scan.
    Measurements of robots and of unknown barcodes, and repetitions within a scan, are dropped and
    counted. Tags follow the subject numbers.

    The default noise is chosen on robots 1 to 3 of data set 1. Bearings within a scan agree with
    the survey to 0.005 rad; 0.01 allows for errors of the time stamps. Ranges deviate by 0.16 to
    0.19 m, with errors that persist for seconds, so that innovations show 0.11 m; 0.15 is between.
    With odometry noise of 0.01 m/√s and 0.05 rad/√s, NIS/dof is then 0.78, 1.22 and 0.92. Since the
    errors of ranges persist, the map's covariance is too small for any choice. There is no gate; a
    gate at 5 σ changes the maps by millimetres.

    Source: Leung, Halpern, Barfoot, Liu, International Journal of Robotics Research 30(8), 2011.

    Args:
        folder: where the files of one data set are.
        robot: number of the robot, 1 to 5.
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
    odometry, seen = read_robot(Path(folder), robot)
    time = np.unique(np.concatenate([odometry[:, 0], seen[:, 0]]))
    row, tag, kept, dropped = _associate(seen, time, subject_of, names)
    return Dataset(
        name=f"mrclam robot {robot}",
        log=_log(odometry, time, row, tag, seen[kept, 2:]),
        time=time,
        motion=unicycle(white_noise(*ODOMETRY_DENSITY) if odometry_cov is None else odometry_cov),
        sensor=range_bearing(measurement_cov),
        tags=names,
        filter_options={"update": "sequential"},
        landmarks=points,
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
    """The data of several robots with common times, and their measurements of each other.

    The log has a row at every time that occurs in a file of any of the robots, with a control
    (v, ω, Δt) for each robot as in `mrclam`. Measurement slots of a scan are ordered by robot,
    those for landmarks before those for robots; tags N, N + 1, … are the robots in the given order.
    The first robot's start is the map's frame. The files do not give the others' starts, which the
    filter has to estimate. Measurements of robots are less accurate than those of landmarks: of
    robots 1 to 3 of data set 1, their innovations have standard deviations of 0.18 m and 0.048 rad
    (NIS/dof 2.5 with the noise of landmarks; `python -m benchmarks --record --only team`), so a
    `sighting_cov` of their own is advisable. Measurements of other robots are dropped and counted;
    all else is as in `mrclam`.

        data = mrclam_team(folder)
        filter = team_slam(data.robots, data.capacity)

    Args:
        folder: where the files of one data set are.
        robots: their numbers, each from 1 to 5, none twice.
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
    subject_of, names, points, corrections = read_landmarks(Path(folder), errata)
    files = [read_robot(Path(folder), robot) for robot in asked]
    time = np.unique(np.concatenate([table[:, 0] for pair in files for table in pair]))
    eye = range_bearing(measurement_cov)
    sight = eye if sighting_cov is None else range_bearing(sighting_cov)
    model = unicycle(white_noise(*ODOMETRY_DENSITY) if odometry_cov is None else odometry_cov)
    team, scans, controls, dropped = [], [], [], dict.fromkeys(_DROPS, 0)
    for odometry, seen in files:
        row, tag, kept, lost = _associate(seen, time, subject_of, names + asked)
        dropped = {why: dropped[why] + lost[why] for why in dropped}
        tags, rows = np.array(tag), np.array(row)
        controls.append(hold(odometry[:, 0], odometry[:, 1:], time))
        parts = []
        for robots_seen in (False, True):
            mine = (tags >= len(names)) == robots_seen
            if mine.any():
                scan = _log(odometry, time, rows[mine], tags[mine], seen[kept, 2:][mine]).scan
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
        landmarks=points,
        dropped=dropped,
        corrections=corrections,
        source=SOURCE,
        robots=tuple(team),
    )


def white_noise(v: float, omega: float) -> NoiseCov:
    """White noise of (v, ω) with covariance density/Δt, so that time steps can be divided.

    v [m²/s], omega [rad²/s]: the variance of travel and heading per second. Where Δt = 0 it is 0.
    """

    def noise_cov(pose: jax.Array, u: jax.Array) -> jax.Array:
        moving = u[2] > 0
        rate = jnp.where(moving, 1 / jnp.where(moving, u[2], 1.0), 0.0)
        return rate * jnp.diag(jnp.stack([jnp.asarray(v, u.dtype), jnp.asarray(omega, u.dtype)]))

    return noise_cov


def _log(
    odometry: Float[np.ndarray, "K 3"],
    time: Float[np.ndarray, "T"],
    row: Any,
    tag: Any,
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
