"""Reader of one robot of MRCLAM, the UTIAS multi-robot localization and mapping data."""

from pathlib import Path

import numpy as np

from jaxslam.datasets.dataset import Dataset
from jaxslam.datasets.mrclam.calibration import RobotCalibration, check_calibration
from jaxslam.datasets.mrclam.files import ROBOTS, read_landmarks
from jaxslam.datasets.mrclam.robot import (
    SOURCE,
    associated,
    log_of,
    models_of,
    read_lines,
    true_fields,
)
from jaxslam.noise import NoiseCov


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
    the robot starts there, with the covariance `mrclam.truth.START_COV`, and path, survey and map
    are in one frame.

    The default noise is chosen on robots 1 to 3 of data set 1. Bearings within a scan agree with
    the survey to 0.005 rad; 0.01 allows for errors of the time stamps. Ranges deviate by 0.16 to
    0.19 m, with errors that persist for seconds, so that innovations show 0.11 m; 0.15 is between.
    With odometry noise of 0.01 m/√s and 0.05 rad/√s, NIS/dof is then 0.78, 1.22 and 0.92. Since the
    errors of ranges persist, the map's covariance is too small for any choice. A `calibration`
    removes what causes them, see `MRCLAM_CALIBRATION` and `mrclam_calibration`. There is no gate; a
    gate at 5 σ changes the maps by millimetres.

    Source: Leung, Halpern, Barfoot, Liu, International Journal of Robotics Research 30(8), 2011.

    Args:
        folder: where the files of one data set are.
        robot: number of the robot, 1 to 5.
        calibration: corrects odometry and ranges, and gives the noise. Default: as recorded.
        odometry_cov: (2, 2) covariance of (v, ω) over a row's Δt, or a function of (pose, u).
        measurement_cov: (2, 2) covariance of (range, bearing), or a function of z.
        errata: exchange the positions of subjects 11 and 17 if they are those of data set 1, see
            `mrclam.files.EXCHANGED`; `Dataset.corrections` then says so.
    Raises:
        ValueError: `path:line: reason` on a malformed line, a time that decreases, a negative
            range, or a subject without survey; on a robot other than 1 to 5, and a calibration
            that is none.
    """
    if type(robot) is not int or robot not in ROBOTS:
        raise ValueError(f"mrclam: expected a robot from 1 to 5, got {robot!r}")
    if calibration is not None:
        check_calibration("mrclam", calibration)
    subject_of, names, points, corrections = read_landmarks(Path(folder), errata)
    own = read_lines(Path(folder), robot, calibration)
    time = np.unique(np.concatenate([own.odometry[:, 0], own.seen[:, 0]]))
    row, tag, kept, dropped = associated(own.seen, time, subject_of, names)
    motion, sensor = models_of(calibration, odometry_cov, measurement_cov)
    return Dataset(
        name=f"mrclam robot {robot}",
        log=log_of(own.odometry, time, row, tag, own.seen[kept, 2:]),
        time=time,
        motion=motion,
        sensor=sensor,
        tags=names,
        filter_options={"correction": "sequential"},
        landmarks=points,
        dropped=dropped,
        corrections=(*corrections, *own.corrections),
        source=SOURCE,
        **true_fields([own], time),
    )
