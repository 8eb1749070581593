"""Reader of several robots of MRCLAM in one log."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from jaxslam.core.logs.streams import Rows, hold
from jaxslam.core.noise import NoiseCov
from jaxslam.core.types import Log
from jaxslam.datasets.dataset import Dataset
from jaxslam.datasets.lines import stored
from jaxslam.datasets.mrclam.calibration import RobotCalibration, check_calibration
from jaxslam.datasets.mrclam.files import ROBOTS, read_landmarks
from jaxslam.datasets.mrclam.robot import (
    DROPS,
    SOURCE,
    associated,
    log_of,
    models_of,
    read_lines,
    true_fields,
)
from jaxslam.filters.multi_robot.team import Robot, TeamMotion, sensors_of
from jaxslam.sensors import Part, Suite


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
    The first robot's start is the map's frame, from its true path where that is known. The others'
    starts are left to the filter. Measurements of robots are less accurate than those of landmarks:
    of robots 1 to 3 of data set 1, their innovations have standard deviations of 0.18 m and
    0.048 rad (NIS/dof 2.5 with the noise of landmarks; `python -m benchmarks --record --only
    team`), so a `sighting_cov` of their own is advisable. Measurements of other robots are dropped
    and counted; all else is as in `mrclam`.

        data = mrclam_team(folder)
        filter = TeamSlam(data.robots, data.capacity)

    Args:
        folder: where the files of one data set are.
        robots: their numbers, each from 1 to 5, none twice.
        calibration: as for `mrclam`; or one for each robot, by its number.
        errata: as for `mrclam`.
        sighting_cov: (2, 2) covariance of (range, bearing) of another robot, or a function of z;
            default that of a landmark.
    Raises:
        ValueError: as `mrclam`, on a robot that measured nothing, on one without calibration where
            others have one, and unless robots are different numbers from 1 to 5.
    """
    asked = tuple(robots)
    good = all(type(robot) is int and robot in ROBOTS for robot in asked)
    if not asked or not good or len(set(asked)) != len(asked):
        raise ValueError(f"mrclam_team: expected different robots from 1 to 5, got {robots!r}")
    subject_of, names, points, corrections = read_landmarks(Path(folder), errata)
    each: list[RobotCalibration | None] = [None] * len(asked)
    if isinstance(calibration, Mapping):
        if missing := [robot for robot in asked if robot not in calibration]:
            raise ValueError(f"mrclam_team: robot {missing[0]} has no calibration")
        each = [calibration[robot] for robot in asked]
    elif calibration is not None:
        each = [calibration] * len(asked)
    for constants in each:
        if constants is not None:
            check_calibration("mrclam_team", constants)
    files = [read_lines(Path(folder), *one) for one in zip(asked, each, strict=True)]
    time = np.unique(np.concatenate([t[:, 0] for own in files for t in (own.odometry, own.seen)]))
    team, scans, controls, dropped = [], [], [], dict.fromkeys(DROPS, 0)
    models = {one: models_of(one) for one in set(each)}
    sights = {one: eye for one, (_, eye) in models.items()}
    if sighting_cov is not None:
        sights = {one: replace(eye, noise_cov=sighting_cov) for one, eye in sights.items()}
    for robot, own, constants in zip(asked, files, each, strict=True):
        (model, eye), sight = models[constants], sights[constants]
        row, tag, kept, lost = associated(own.seen, time, subject_of, names + asked)
        dropped = {why: dropped[why] + lost[why] for why in dropped}
        if not tag:
            seen = Path(folder) / f"Robot{robot}_Measurement.dat"
            raise ValueError(
                f"{stored(seen)}:1: no measurement of a landmark, or of a robot in {asked}"
            )
        tags, rows = np.array(tag), np.array(row)
        controls.append(hold(own.odometry[:, 0], own.odometry[:, 1:], time))
        parts = []
        for robots_seen in (False, True):
            mine = (tags >= len(names)) == robots_seen
            if mine.any():
                z = own.seen[kept, 2:][mine]
                scan = log_of(own.odometry, time, rows[mine], tags[mine], z).scan
                sees: Literal["landmarks", "robots"] = "robots" if robots_seen else "landmarks"
                sensor = sight if robots_seen else eye
                parts.append(Part(sensor, scan.tag.shape[1], sees=sees))
                scans.append(scan)
        team.append(Robot(model, Suite((*parts,))))
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
        motion=TeamMotion(tuple(robot.motion for robot in team), 0),
        sensor=sensors_of(team, 0),
        tags=names,
        filter_options={"correction": "sequential"},
        landmarks=points,
        dropped=dropped,
        corrections=(*corrections, *(line for own in files for line in own.corrections)),
        source=SOURCE,
        robots=tuple(team),
        **true_fields(files, time),
    )
