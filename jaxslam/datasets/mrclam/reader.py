"""Reader of one robot of MRCLAM, the UTIAS multi-robot localization and mapping data.

And the systematic errors of that robot, found in its own log.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.calibration import Calibration, calibrate
from jaxslam.charts import RightInvariant
from jaxslam.core.numbers import is_concrete
from jaxslam.core.protocols import Motion, Sensor
from jaxslam.core.types import Info, Log
from jaxslam.datasets.dataset import Dataset
from jaxslam.datasets.mrclam.calibration import (
    MRCLAM_CALIBRATION,
    RobotCalibration,
    check_calibration,
)
from jaxslam.datasets.mrclam.files import ROBOTS, read_landmarks
from jaxslam.datasets.mrclam.robot import (
    SOURCE,
    associated,
    log_of,
    models_of,
    read_lines,
    true_fields,
)
from jaxslam.filters.ekf.ekf_slam import EkfSlam
from jaxslam.filters.ekf.settings import EkfOptions
from jaxslam.math.stats import sigma_gate
from jaxslam.motion import Unicycle
from jaxslam.run import run
from jaxslam.sensors import RangeBearing


def mrclam(
    folder: str | Path,
    robot: int = 1,
    *,
    calibration: RobotCalibration | None = None,
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
    the robot starts there, with the covariance `mrclam.robot.START_COV`, and path, survey and map
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
    motion, sensor = models_of(calibration)
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


MRCLAM_FITTED = ("forward", "outer", "turn", "curvature", "ahead", "yaw", "axis")
"""What a log tells of a `RobotCalibration`; it does not tell `depth` beside `forward`."""


class OwnCalibration(NamedTuple):
    """The calibration of a robot by its own log, and how it was found.

    `at(p, scale=1.0)` returns the log and the models (`Log`, `Motion`, `Sensor`) with other
    constants p (7,), in the order of `MRCLAM_FITTED`; ranges and travel, which no log tells apart,
    are both larger by a scale. p and the scale may be traced:

        def poses(p):
            log, motion, sensor = own.at(p[:-1], scale=1 + p[-1])
            filter = EkfSlam(motion, sensor, data.capacity, **data.filter_options)
            return run(filter, log, data.pose, data.pose_cov, key).estimate.pose

        p = [*own.found.parameters, 0.0]
        added = calibration.consider_cov(poses, p, block_diag(own.found.cov, 0.02**2))
    """

    robot: RobotCalibration
    found: Calibration
    """of `MRCLAM_FITTED`, in that order"""
    at: Callable[..., tuple[Log, Motion, Sensor]]
    """(p (7,), scale=1.0) -> log, motion, sensor"""


def mrclam_calibration(
    folder: str | Path,
    robot: int = 1,
    *,
    known: RobotCalibration = MRCLAM_CALIBRATION,
    gate: float = 5.0,
    errata: bool = True,
) -> OwnCalibration:
    """The systematic errors of one robot that make its innovations least, by its own log.

    `calibration.calibrate` on the innovations of the right-invariant EKF: wheels (`forward`,
    `outer`, `turn`, `curvature`), place and yaw of the camera (`ahead`, `yaw`), and its optical
    axis (`axis`).
    Neither the true path nor the survey is used (where there is a true path, `mrclam` cuts lines
    (0, 0) after its end). Delay, noise and `depth` are those of `known`:
    ranges and odometry in proportion larger are the same log of a larger world, so the scale of the
    map is that of `depth`.

        own = mrclam_calibration(folder, 5)
        data = mrclam(folder, 5, calibration=own.robot)

    Args:
        folder, robot, errata: as for `mrclam`.
        known: what is held, and where the search starts.
        gate: [σ] of innovations.
    Raises:
        ValueError: as `mrclam` and `calibrate` do.
    """
    check_calibration("mrclam_calibration", known)
    data = mrclam(
        folder,
        robot,
        calibration=known._replace(
            forward=1.0, outer=0.0, turn=1.0, curvature=0.0, depth=1.0, axis=0.0
        ),
        errata=errata,
    )
    bearing = np.asarray(data.log.scan.z[..., 1])
    depth = np.asarray(data.log.scan.z[..., 0]) * np.cos(bearing)

    def at(p: jax.Array, scale: jax.Array | float = 1.0) -> tuple[Log, Motion, Sensor]:
        if np.shape(p) != (len(MRCLAM_FITTED),) or (is_concrete(scale) and not float(scale) > 0):
            raise ValueError(
                f"OwnCalibration.at: expected constants of shape {(len(MRCLAM_FITTED),)} and a "
                f"scale above 0, got {np.shape(p)} and {scale}"
            )
        traced = cast("dict[str, float]", dict(zip(MRCLAM_FITTED, p, strict=True)))
        own = known._replace(**traced)
        v, omega, dt = jnp.asarray(data.log.control).T
        forward, turn = own.velocities(v, omega)
        phi = jnp.asarray(bearing)
        z = jnp.stack([scale * own.range(jnp.asarray(depth), phi), phi], axis=-1)
        log = data.log._replace(
            control=jnp.stack([scale * forward, turn, dt], axis=-1),
            scan=data.log.scan._replace(z=z),
        )
        ahead = scale * own.ahead
        mount = jnp.stack([ahead, 0.0 * ahead, own.yaw])
        return log, Unicycle(own.odometry_cov()), RangeBearing(own.measurement_cov(), mount=mount)

    def info(p: jax.Array) -> Info:
        log, motion, sensor = at(p)
        more: EkfOptions = {"gate": sigma_gate(gate), "chart": RightInvariant()}
        options = data.filter_options | more
        filter = EkfSlam(motion, sensor, data.capacity, **options)
        return run(filter, log, jnp.zeros(3), jnp.zeros((3, 3)), jax.random.key(0)).info

    found = calibrate(info, [getattr(known, name) for name in MRCLAM_FITTED])
    values = dict(zip(MRCLAM_FITTED, found.parameters.tolist(), strict=True))
    return OwnCalibration(known._replace(**values), found, at)
