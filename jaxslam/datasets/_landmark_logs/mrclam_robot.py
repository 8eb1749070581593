"""One robot of MRCLAM: its files as tables, its systematic errors, its models and its true path."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from jaxslam import motion
from jaxslam.calibration import delayed
from jaxslam.core._numbers import is_concrete
from jaxslam.core.logs._streams import hold, known_poses
from jaxslam.core.protocols import Motion, Sensor
from jaxslam.core.types import JaxOrNumPy, Log
from jaxslam.core.validation import InvalidField, instance_of
from jaxslam.datasets._account import Account
from jaxslam.datasets._dataset import Adjustable, Parameter
from jaxslam.datasets._lines import TextFile, stored_file
from jaxslam.motion import Unicycle, WhiteNoise
from jaxslam.sensors import RangeBearing, RangeBearingNoise

ROBOTS = range(1, 6)
"""Subjects 1 to 5 are the robots; they carry barcodes like the landmarks, 6 to 20."""
EXCHANGED = {11: [3.15071999, 2.38294871], 17: [0.03596156, -2.84396626]}
"""Positions of two subjects that are exchanged in the survey of data set 1, as in the file: their
distances from landmarks of the same scan differ by metres from the survey, and by centimetres after
the exchange."""


def read_landmarks(
    folder: Path, errata: bool, account: Account
) -> tuple[dict[int, int], tuple[int, ...], Float[np.ndarray, "N 2"]]:
    """The subject of each barcode, and the subjects and positions of the landmarks.

    errata: exchange the positions of `EXCHANGED`, if they are those of the file.
    """
    file = TextFile(folder / "Barcodes.dat", "#")
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

    file = TextFile(folder / "Landmark_Groundtruth.dat", "#")
    points: dict[int, list[float]] = {}
    for line, fields in file:
        columns = ("subject", "x", "y", "sigma_x", "sigma_y")
        _, x, y, _, _ = file.numbers(line, fields, columns)
        subject = file.identity(line, fields[0], "subject")
        if subject not in names:
            raise file.error(line, f"subject {subject} is not a landmark in Barcodes.dat")
        if subject in points:
            raise file.error(line, f"subject {subject} occurs twice")
        points[subject] = [x, y]
    missing = [name for name in names if name not in points]
    if missing:
        raise file.end_error(f"no position of subject {missing[0]} in the file")
    if errata and all(points.get(subject) == at for subject, at in EXCHANGED.items()):
        first, second = EXCHANGED
        points[first], points[second] = points[second], points[first]
        account.correct(f"the surveyed positions of subjects {first} and {second} were exchanged")
    return subject_of, names, np.array([points[name] for name in names])


def read_robot(
    folder: Path, robot: int
) -> tuple[Float[np.ndarray, "K 3"], Float[np.ndarray, "J 4"]]:
    """Odometry (t, v, ω) and measurements (t, barcode, range, bearing) of one robot."""
    odometry = _read_in_time(
        TextFile(folder / f"Robot{robot}_Odometry.dat", "#"), ("time", "v", "omega")
    )
    measurements = _read_in_time(
        TextFile(folder / f"Robot{robot}_Measurement.dat", "#"),
        ("time", "barcode", "range", "bearing"),
    )
    return odometry, measurements


def read_truth(folder: Path, robot: int) -> Float[np.ndarray, "K 4"] | None:
    """The true poses (t, x, y, θ) of one robot; None without a file."""
    path = folder / f"Robot{robot}_Groundtruth.dat"
    if stored_file(path) is None:
        return None
    return _read_in_time(TextFile(path, "#"), ("time", "x", "y", "theta"))


def _read_in_time(file: TextFile, names: tuple[str, ...]) -> Float[np.ndarray, "_ _"]:
    """A table whose first column does not decrease; raises ValueError otherwise."""
    lines, table = file.table(names)
    if (back := np.flatnonzero(np.diff(table[:, 0]) < 0)).size:
        before, after = table[back[0] : back[0] + 2, 0]
        raise file.error(lines[back[0] + 1], f"time goes back from {before} to {after}")
    if names[1] == "barcode":
        for line, fields in file:
            file.identity(line, fields[1], "barcode")
        if (negative := np.flatnonzero(table[:, 2] < 0)).size:
            row = negative[0]
            raise file.error(lines[row], f"the range {table[row, 2]} is negative")
    return table


class RobotCalibration(NamedTuple):
    """The systematic errors of a robot's odometry and camera, and the noise that remains.

    A recorded velocity at time t moves the robot at time t + delay, with the errors of
    `motion.Corrected`. The camera is at (ahead, 0, yaw) on the robot. Its range r is `depth` times
    the depth along the optical axis, as the height of a barcode in the image gives it. That axis
    has the bearing `axis`, so that with the recorded bearing φ the range is

        r' = r / (depth cos(φ - axis))

    Noise, of r' and φ, is that of `motion.WhiteNoise` and `sensors.RangeBearingNoise`. Fields may
    be traced.
    """

    delay: float
    """[s], of odometry after measurements"""
    forward: float
    outer: float
    """[m]"""
    turn: float
    curvature: float
    """[rad/m]"""
    depth: float
    ahead: float
    """[m]"""
    yaw: float
    """[rad]"""
    axis: float
    """[rad]"""
    forward_noise: float
    """[m/√s]"""
    turn_noise: float
    """[rad/√s]"""
    turn_share: float
    """[√s]"""
    range_share: float
    bearing_noise: float
    """[rad]"""

    @property
    def motion(self) -> Motion:
        """The motion of the robot by its recorded velocities."""
        noise = WhiteNoise(self.forward_noise, self.turn_noise, self.turn_share)
        scale, wheels = _stack(self.forward, self.turn), _stack(self.outer, self.curvature)
        return motion.Corrected(Unicycle(noise), scale, wheels)

    @property
    def sensor(self) -> Sensor:
        """The camera, of corrected ranges."""
        noise = RangeBearingNoise(0.0, self.bearing_noise, share=self.range_share)
        return RangeBearing(noise, mount=_stack(self.ahead, 0.0, self.yaw))

    def range_factor(self, bearing: JaxOrNumPy) -> JaxOrNumPy:
        """Recorded over corrected range at a bearing, depth cos(φ - axis)."""
        cos = np.cos if is_concrete(self.axis) else jnp.cos
        return self.depth * cos(bearing - self.axis)


def _stack(*numbers: float) -> ArrayLike:
    """Numbers as a vector: NumPy's, unless one is traced."""
    return (
        np.array(numbers)
        if all(map(is_concrete, numbers))
        else jnp.stack([*map(jnp.asarray, numbers)])
    )


GROUPS = {
    "delay": "delay",
    "forward": "scale",
    "turn": "scale",
    "outer": "wheels",
    "curvature": "wheels",
    "depth": "range",
    "ahead": "mount",
    "yaw": "mount",
    "axis": "axis",
}
"""Group of each field that `fit` can calibrate. Noises are held: the constants change the ranges,
so likelihoods of different constants would be of different data; innovations weighted by a fixed
noise can be compared."""


def adjustable_of(
    calibration: RobotCalibration, log: Log, time: Float[np.ndarray, "T"]
) -> Adjustable:
    """Log and models as functions of the systematic errors of a calibration, in its order."""
    controls = calibration.motion.controls
    parameters = tuple(
        Parameter(field, float(value), GROUPS[field], ("calibration", field))
        for field, value in calibration._asdict().items()
        if field in GROUPS
    )
    bearing = np.asarray(log.scan.z[..., 1])
    recorded = np.asarray(log.scan.z[..., 0]) * calibration.range_factor(bearing)

    def at(p: jax.Array) -> tuple[Log, Motion, Sensor]:
        # The groups name the first fields of a calibration, in order; the noises follow.
        adjusted = RobotCalibration(*p, *calibration[len(GROUPS) :])
        # The reader has shifted the odometry by the delay of `calibration`.
        shifted = delayed(log, time, controls, adjusted.delay - calibration.delay)
        ranges = jnp.asarray(recorded) / adjusted.range_factor(jnp.asarray(bearing))
        z = jnp.stack([ranges, jnp.asarray(bearing)], axis=-1)
        return shifted._replace(scan=log.scan._replace(z=z)), adjusted.motion, adjusted.sensor

    return Adjustable(parameters, at)


MRCLAM_CALIBRATION = RobotCalibration(
    delay=0.265,
    forward=1.049,
    outer=0.098,
    turn=0.956,
    curvature=-0.039,
    depth=1.017,
    ahead=-0.034,
    yaw=0.0,
    axis=0.0,
    forward_noise=0.0091,
    turn_noise=0.0219,
    turn_share=0.186,
    range_share=0.0098,
    bearing_noise=0.0183,
)
"""Fitted on the true path of robot 1 of data set 6 (`python -m benchmarks --only mrclam_fit`).

The yaw and the axis of the camera are left at zero, since they differ from robot to robot; `fit`
finds them from the log of a robot.

The ranges of that robot deviate from the survey by 0.12 m as recorded, by a function of the
bearing, and by 1 % of the range once corrected. Persistent errors are included: the noise of
the odometry is that of windows of 8 s, that of the camera of single measurements and the truth."""


def robot_calibration(value: Any) -> RobotCalibration:
    """The check of a calibration: finite numbers, its depth above 0, its noise not negative."""
    calibration: RobotCalibration = instance_of(RobotCalibration)(value)
    for field, entry in calibration._asdict().items():
        try:
            number = float(entry)
        except (TypeError, ValueError):
            number = np.nan
        good, expected = np.isfinite(number), "a finite number"
        if field == "depth":
            good, expected = good and number > 0, f"{expected} above 0"
        elif field.endswith(("_noise", "_share")):
            good, expected = good and number >= 0, f"{expected} >= 0"
        if not good:
            raise InvalidField(field, f"expected {expected}, got {entry!r}")
    return calibration


MAX_TRUTH_GAP = 0.2
"""Largest time between lines of the truth over which it is interpolated [s]."""
START_COV = np.diag([0.01, 0.01, 0.03]) ** 2
"""Covariance of a true pose. Of robot 1 of data set 6, headings that two landmarks give agree with
the recorded ones to 0.03 rad, with errors that persist for tens of seconds."""


def cut_after(
    odometry: Float[np.ndarray, "K 3"], end: float
) -> tuple[Float[np.ndarray, "J 3"], int]:
    """Odometry without the (0, 0) lines at its end that are later than `end`, and their number.

    A recorder that runs on after the robot has stopped writes such lines. The first one stays, so
    that the velocity is zero from then on.
    """
    moving = np.flatnonzero(odometry[:, 1:].any(axis=1) | (odometry[:, 0] <= end))
    keep = min(int(moving[-1]) + 2 if moving.size else 1, len(odometry))
    return odometry[:keep], len(odometry) - keep


def true_poses(
    truth: Float[np.ndarray, "K 4"], time: Float[np.ndarray, "T"]
) -> tuple[Float[np.ndarray, "T 3"], Bool[np.ndarray, "T"]]:
    """True poses at some times, linear between lines of the truth, and where they are known.

    They are unknown before the first line, after the last, and between lines more than
    `MAX_TRUTH_GAP` apart.
    """
    return known_poses(truth[:, 0], truth[:, 1:], time, MAX_TRUTH_GAP)


SOURCE = (
    "K. Y. K. Leung, Y. Halpern, T. D. Barfoot, H. H. T. Liu, The UTIAS multi-robot cooperative "
    "localization and mapping dataset, International Journal of Robotics Research 30(8), 2011"
)
ODOMETRY_NOISE = (0.01, 0.05)
"""Standard deviations of travel [m/√s] and heading [rad/√s]."""
MEASUREMENT_COV = np.diag([0.15, 0.01]) ** 2
DROP_REASONS = ("robot sightings", "unknown barcodes", "repeated in a scan")


class RobotLines(NamedTuple):
    """The lines of a robot; with a calibration, odometry is delayed and ranges are corrected."""

    odometry: Float[np.ndarray, "K 3"]
    """(t, v, ω)"""
    measurements: Float[np.ndarray, "J 4"]
    """(t, barcode, range, bearing)"""
    truth: Float[np.ndarray, "G 4"] | None
    """(t, x, y, θ)"""


def read_lines(
    folder: Path, robot: int, calibration: RobotCalibration | None, account: Account
) -> RobotLines:
    """Read the lines of a robot.

    With a calibration, odometry is at the times when the robot moves, and ranges are corrected.
    Raises ValueError on a bearing beyond a right angle, behind the image plane of the camera.
    """
    odometry, measurements = read_robot(folder, robot)
    truth = read_truth(folder, robot)
    if truth is not None:
        odometry, cut = cut_after(odometry, truth[-1, 0])
        account.correct(
            f"{cut:,} odometry lines (0, 0) of robot {robot} after its true path were left out", cut
        )
    if calibration is not None:
        odometry[:, 0] += calibration.delay
        beyond = np.abs(measurements[:, 3] - calibration.axis) >= np.pi / 2
        if beyond.any():
            bearing = measurements[beyond, 3][0]
            raise ValueError(f"Calibration: expected bearings below π/2, got {bearing}")
        measurements[:, 2] /= calibration.range_factor(measurements[:, 3])
    return RobotLines(odometry, measurements, truth)


def models_of(calibration: RobotCalibration | None) -> tuple[Motion, Sensor]:
    """The motion model and the sensor of a robot, calibrated or as recorded."""
    if calibration is None:
        return Unicycle(WhiteNoise(*ODOMETRY_NOISE)), RangeBearing(MEASUREMENT_COV)
    return calibration.motion, calibration.sensor


def true_fields(files: Sequence[RobotLines], time: Float[np.ndarray, "T"]) -> dict[str, Any]:
    """The fields of a `Dataset` about true paths and the start; none without a true path."""
    if files[0].truth is None:
        return {}
    path, is_known = true_poses(files[0].truth, time)
    fields: dict[str, Any] = {"true_path": path, "true_at": is_known}
    truths = [lines.truth for lines in files if lines.truth is not None]
    if len(files) > 1 and len(truths) == len(files):
        paths, are_known = zip(*(true_poses(truth, time) for truth in truths), strict=True)
        fields |= {"true_paths": np.stack(paths), "true_paths_at": np.stack(are_known)}
    if is_known[0]:
        fields |= {"pose": path[0], "pose_cov": START_COV, "one_frame": True}
    return fields


def log_of(
    odometry: Float[np.ndarray, "K 3"],
    time: Float[np.ndarray, "T"],
    row: Int[np.ndarray, "J"] | list[int],
    tag: Int[np.ndarray, "J"] | list[int],
    z: Float[np.ndarray, "J Z"],
) -> Log:
    """The log of odometry (t, v, ω) and of measurements in some rows."""
    return Log.from_streams((odometry[:, 0], odometry[:, 1:]), (time[row], tag, z), hold, time)


def associate(
    measurements: Float[np.ndarray, "J 4"],
    time: Float[np.ndarray, "T"],
    subject_of: dict[int, int],
    names: tuple[int, ...],
    account: Account,
) -> tuple[list[int], list[int], list[int]]:
    """Row, tag and index of the measurements kept.

    names: the subjects, landmarks first; their tags are their indices in the list.
    """
    tag_of = {name: tag for tag, name in enumerate(names)}
    kept: dict[tuple[int, int], int] = {}  # (row, tag) -> index of the measurement
    row = np.searchsorted(time, measurements[:, 0])
    for k, barcode in enumerate(measurements[:, 1]):
        subject = subject_of.get(int(barcode))
        if subject is None:
            account.drop("unknown barcodes")
        elif subject not in tag_of:
            account.drop("robot sightings")
        elif (int(row[k]), tag_of[subject]) in kept:
            account.drop("repeated in a scan")
        else:
            kept[int(row[k]), tag_of[subject]] = k
    return [r for r, _ in kept], [t for _, t in kept], list(kept.values())
