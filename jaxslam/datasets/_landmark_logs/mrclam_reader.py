"""Readers of MRCLAM, the UTIAS multi-robot data: of one robot, and of several in one log."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from jaxslam.core._noise import NoiseCov
from jaxslam.core._numbers import is_whole
from jaxslam.core.logs._streams import Rows, hold
from jaxslam.core.types import Log
from jaxslam.core.validation import InvalidField, or_none, refusals_of, require
from jaxslam.datasets._account import Account
from jaxslam.datasets._dataset import Dataset
from jaxslam.datasets._landmark_logs.mrclam_robot import (
    DROP_REASONS,
    ROBOTS,
    SOURCE,
    RobotCalibration,
    adjustable_of,
    associate,
    log_of,
    models_of,
    read_landmarks,
    read_lines,
    robot_calibration,
    true_fields,
)
from jaxslam.datasets._lines import stored_file
from jaxslam.sensors import Part, Suite
from jaxslam.sensors._team import Robot, TeamMotion, sensors_of


def mrclam(
    folder: str | Path,
    robot: int = 1,
    *,
    calibration: RobotCalibration | None = None,
    errata: bool = True,
) -> Dataset:
    """The data of one robot in the files of a folder, each `NAME.dat` or `NAME.dat.gz`.

    These are `Robot{n}_Odometry.dat` (t v ω), `Robot{n}_Measurement.dat` (t barcode range bearing),
    `Barcodes.dat` (the subject of each barcode), `Landmark_Groundtruth.dat` (the survey) and,
    optionally, `Robot{n}_Groundtruth.dat` (t x y θ).

    The log has a row at every time that occurs in either of the first two. Its control is
    (v, ω, Δt): the velocity of the latest odometry line at or before the row before, and the time
    since that row; zero before the first odometry line. So Δt = 0 in the first row only, and of
    odometry lines with equal times the last one counts. Measurements of one time form one scan.
    Measurements of robots and of unknown barcodes, and repetitions within a scan, are dropped and
    counted. Tags follow the subject numbers.

    With a true path, odometry lines (0, 0) after its end, at the end of the file, are left out but
    for the first (counted in `Dataset.corrections`). If the true pose is known in the first row,
    the robot starts there, with the covariance `mrclam_robot.START_COV`, and path, survey and map
    are in one frame.

    The default noise is chosen on robots 1 to 3 of data set 1. Bearings within a scan agree with
    the survey to 0.005 rad; 0.01 allows for errors of the time stamps. Ranges deviate by 0.16 to
    0.19 m, with errors that persist for seconds, so that innovations show 0.11 m; 0.15 is between.
    With odometry noise of 0.01 m/√s and 0.05 rad/√s, NIS/dof is then 0.78, 1.22 and 0.92. Since the
    errors of ranges persist, the map's covariance is too small for any choice. A `calibration`
    removes their causes, and `fit` finds that of a robot from its log, without truth or survey:

        fitted = fit(
            mrclam(folder, 5, calibration=MRCLAM_CALIBRATION),
            calibrate=("scale", "wheels", "mount", "axis"),
            options={"gate": stats.sigma_gate(5, 2)},
        )
        data = mrclam(folder, 5, calibration=MRCLAM_CALIBRATION._replace(**fitted.by_name))

    Larger ranges and odometry in proportion give the same log of a larger world, so that `depth`
    sets the scale of the map. The default is without a gate; a gate at 5 σ changes the maps by
    millimetres.

    Source: Leung, Halpern, Barfoot, Liu, International Journal of Robotics Research 30(8), 2011.

    Args:
        folder: where the files of one data set are.
        robot: number of the robot, 1 to 5.
        calibration: the systematic errors of odometry and ranges, and the noise. Default: none, and
            a noise for both together.
        errata: exchange the positions of subjects 11 and 17 if they are those of data set 1, see
            `mrclam_robot.EXCHANGED`; noted in `Dataset.corrections`.
    Raises:
        ValueError: `path:line: reason` on a malformed line, a time that decreases, a negative
            range, or a subject without survey; on a robot other than 1 to 5, and on a calibration
            of another kind.
    """
    with refusals_of("mrclam"):
        if not is_whole(robot) or robot not in ROBOTS:
            raise InvalidField("robot", f"expected a number from 1 to 5, got {robot!r}")
        require("calibration", calibration, or_none(robot_calibration))
    account = Account(dict.fromkeys(DROP_REASONS, 0))
    subject_of, names, points = read_landmarks(Path(folder), errata, account)
    lines = read_lines(Path(folder), robot, calibration, account)
    time = np.unique(np.concatenate([lines.odometry[:, 0], lines.measurements[:, 0]]))
    row, tag, kept = associate(lines.measurements, time, subject_of, names, account)
    if not tag:
        raise account.none_left(stored_file(Path(folder) / f"Robot{robot}_Measurement.dat"), 1)
    motion, sensor = models_of(calibration)
    log = log_of(lines.odometry, time, row, tag, lines.measurements[kept, 2:])
    return Dataset(
        name=f"mrclam robot {robot}",
        log=log,
        time=time,
        motion=motion,
        sensor=sensor,
        tags=names,
        filter_options={"correction": "sequential"},
        landmarks=points,
        adjustable=None if calibration is None else adjustable_of(calibration, log, time),
        **account.fields,
        source=SOURCE,
        **true_fields([lines], time),
    )


def mrclam_team(
    folder: str | Path,
    robots: tuple[int, ...] = (1, 2, 3),
    *,
    calibration: RobotCalibration | Mapping[int, RobotCalibration] | None = None,
    sighting_cov: NoiseCov | None = None,
    errata: bool = True,
) -> Dataset:
    """The data of several robots with common times, and their measurements of each other.

    The log has a row at every time that occurs in a file of any of the robots, with a control
    (v, ω, Δt) for each robot as in `mrclam`. Measurement slots of a scan are ordered by robot,
    those for landmarks before those for robots; tags N, N + 1, … are the robots in the given order.
    The frame of the map is the start of the first robot, from its true path if known. The filter
    finds the starts of the others. Measurements of robots are less accurate than those of
    landmarks: of robots 1 to 3 of data set 1, their innovations have standard deviations of 0.18 m
    and 0.048 rad (NIS/dof 2.5 with the noise of landmarks; `python -m benchmarks --record --only
    team`), so set `sighting_cov`. Measurements of other robots are dropped and counted; all else is
    as in `mrclam`.

        data = mrclam_team(folder)
        filter = TeamSlam(data.robots, data.capacity)

    Args:
        folder: where the files of one data set are.
        robots: their numbers, different ones from 1 to 5.
        calibration: as for `mrclam`, or a mapping from the number of each robot.
        errata: as for `mrclam`.
        sighting_cov: (2, 2) covariance of (range, bearing) of another robot, or a function of z;
            default that of a landmark.
    Raises:
        ValueError: as `mrclam`, on a robot without measurements or missing in a mapping of
            calibrations, and unless robots are different numbers from 1 to 5.
    """
    numbers = tuple(robots)
    good = all(is_whole(robot) and robot in ROBOTS for robot in numbers)
    with refusals_of("mrclam_team"):
        if not numbers or not good or len(set(numbers)) != len(numbers):
            raise InvalidField("robots", f"expected different ones from 1 to 5, got {robots!r}")
        calibrations: list[RobotCalibration | None] = [None] * len(numbers)
        if isinstance(calibration, Mapping):
            if missing := [robot for robot in numbers if robot not in calibration]:
                raise InvalidField("calibration", f"robot {missing[0]} has none")
            calibrations = [calibration[robot] for robot in numbers]
        elif calibration is not None:
            calibrations = [calibration] * len(numbers)
        for constants in calibrations:
            require("calibration", constants, or_none(robot_calibration))
    account = Account(dict.fromkeys(DROP_REASONS, 0))
    subject_of, names, points = read_landmarks(Path(folder), errata, account)
    files = [
        read_lines(Path(folder), robot, constants, account)
        for robot, constants in zip(numbers, calibrations, strict=True)
    ]
    clocks = [table[:, 0] for lines in files for table in (lines.odometry, lines.measurements)]
    time = np.unique(np.concatenate(clocks))
    team, scans, controls = [], [], []
    # Robots of equal constants share their models.
    models = {constants: models_of(constants) for constants in set(calibrations)}
    sighting_sensors = {constants: sensor for constants, (_, sensor) in models.items()}
    if sighting_cov is not None:
        sighting_sensors = {
            constants: replace(sensor, noise_cov=sighting_cov)
            for constants, sensor in sighting_sensors.items()
        }
    for robot, lines, constants in zip(numbers, files, calibrations, strict=True):
        motion, sensor = models[constants]
        row, tag, kept = associate(lines.measurements, time, subject_of, names + numbers, account)
        if not tag:
            path = Path(folder) / f"Robot{robot}_Measurement.dat"
            raise ValueError(
                f"{stored_file(path)}:1: no measurement of a landmark, or of a robot in {numbers}"
            )
        tags, rows = np.array(tag), np.array(row)
        controls.append(hold(lines.odometry[:, 0], lines.odometry[:, 1:], time))
        parts = []
        of_robots = tags >= len(names)
        sees: Literal["landmarks", "robots"]
        for sees, part_sensor, chosen in (
            ("landmarks", sensor, ~of_robots),
            ("robots", sighting_sensors[constants], of_robots),
        ):
            if chosen.any():
                z = lines.measurements[kept, 2:][chosen]
                scan = log_of(lines.odometry, time, rows[chosen], tags[chosen], z).scan
                parts.append(Part(part_sensor, scan.tag.shape[1], sees=sees))
                scans.append(scan)
        team.append(Robot(motion, Suite((*parts,))))
    return Dataset(
        name=f"mrclam robots {', '.join(map(str, numbers))}",
        log=Log.from_rows(
            Rows(
                time,
                np.concatenate(controls, axis=1),
                *(np.concatenate(parts, axis=1) for parts in zip(*scans, strict=True)),
            )
        ),
        time=time,
        motion=TeamMotion(tuple(robot.motion for robot in team), 0),
        sensor=sensors_of(team, 0),
        tags=names,
        filter_options={"correction": "sequential"},
        landmarks=points,
        **account.fields,
        source=SOURCE,
        robots=tuple(team),
        **true_fields(files, time),
    )
