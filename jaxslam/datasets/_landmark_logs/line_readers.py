"""Readers of files with a keyword per line: Bonn course data, Victoria Park as in GTSAM."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxslam.core._noise import NoiseCov
from jaxslam.core.logs._streams import as_recorded
from jaxslam.core.types import Log
from jaxslam.core.validation import InvalidField, covariance, require
from jaxslam.datasets._account import Account
from jaxslam.datasets._dataset import Dataset
from jaxslam.datasets._lines import TextFile
from jaxslam.motion import PoseIncrement
from jaxslam.sensors import RangeBearing, RelativePosition

_BONN_SOURCE = (
    "C. Stachniss, Robot Mapping, course exercises, University of Freiburg and University of Bonn"
)
# By maximum likelihood, see `bonn`.
_BONN_ODOMETRY_COV = np.diag([0.001, 0.001, 0.001]) ** 2
_BONN_MEASUREMENT_COV = np.diag([0.1, 0.05]) ** 2


def bonn(folder: str | Path) -> Dataset:
    """The data set in the files `world.dat` (landmarks: id x y) and `sensor_data.dat` of a folder.

    `sensor_data.dat` has a line `ODOMETRY rot1 trans rot2` for each step, followed by lines
    `SENSOR id range bearing` of that step. The motion is the pose increment
    (trans cos rot1, trans sin rot1, rot1 + rot2). Next to a landmark the simulated noise can make a
    range negative; such a measurement has no direction, and is dropped and counted.

    The default noise maximizes the likelihood of the innovations of an EKF, rounded: 0.1 m and
    0.05 rad for the sensor; for the odometry it only shows that σ is about 0.001 per step (m or
    rad). NIS/dof is then 0.95.

    Source: course data by C. Stachniss, University of Freiburg and University of Bonn.

    Args:
        folder: the folder of the two files.
    Raises:
        ValueError: `path:line: reason` on a malformed line, a landmark that is not in `world.dat`
            or is measured twice in a step, or a SENSOR line before the first ODOMETRY.
    """
    names, landmarks = _read_world(TextFile(Path(folder) / "world.dat"))
    tag_of = {name: tag for tag, name in enumerate(names)}
    file = TextFile(Path(folder) / "sensor_data.dat")
    controls: list[list[float]] = []
    rows: list[int] = []
    tags: list[int] = []
    z: list[list[float]] = []
    in_step: set[int] = set()
    account = Account({"negative ranges": 0})
    for line, (keyword, *fields) in file:
        if keyword == "ODOMETRY":
            rot1, trans, rot2 = file.numbers(line, fields, ("rot1", "trans", "rot2"))
            controls.append([trans * np.cos(rot1), trans * np.sin(rot1), rot1 + rot2])
            in_step = set()
        elif keyword == "SENSOR":
            _, distance, bearing = file.numbers(line, fields, ("id", "range", "bearing"))
            name = file.identity(line, fields[0], "id")
            if not controls:
                raise file.error(line, "SENSOR before the first ODOMETRY")
            if name not in tag_of:
                raise file.error(line, f"landmark {name} is not in world.dat")
            if name in in_step:
                raise file.error(line, f"landmark {name} is measured twice in a step")
            in_step.add(name)
            if distance < 0:
                account.drop("negative ranges")
                continue
            rows.append(len(controls) - 1)
            tags.append(tag_of[name])
            z.append([distance, bearing])
        else:
            raise file.error(line, f"unknown keyword {keyword!r}")
    if not z:
        if account.dropped["negative ranges"]:
            raise account.none_left(file.path, len(file.lines))
        raise file.end_error(f"no {'SENSOR' if controls else 'ODOMETRY'} line in the file")
    time = np.arange(1.0, len(controls) + 1.0)
    return Dataset(
        name="bonn",
        log=Log.from_streams((time, controls), (time[rows], tags, z), as_recorded, time),
        time=time,
        motion=PoseIncrement(_BONN_ODOMETRY_COV),
        sensor=RangeBearing(_BONN_MEASUREMENT_COV),
        tags=names,
        filter_options={"correction": "joint"},
        landmarks=landmarks,
        **account.fields,
        source=_BONN_SOURCE,
    )


def _read_world(file: TextFile) -> tuple[tuple[int, ...], np.ndarray]:
    """The landmarks' ids in rising order and their positions (N, 2)."""
    points: dict[int, list[float]] = {}
    for line, fields in file:
        _, x, y = file.numbers(line, fields, ("id", "x", "y"))
        name = file.identity(line, fields[0], "id")
        if name in points:
            raise file.error(line, f"landmark {name} occurs twice")
        points[name] = [x, y]
    if not points:
        raise file.end_error("no landmark in the file")
    names = tuple(sorted(points))
    return names, np.array([points[name] for name in names])


_VICTORIA_PARK_SOURCE = (
    "Victoria Park: J. Guivant and E. Nebot, Optimization of the simultaneous localization and "
    "map-building algorithm for real-time implementation, IEEE Transactions on Robotics and "
    "Automation 17(3), 2001; victoria_park.txt as distributed with GTSAM"
)
_ODOMETRY = ("i", "j", "dx", "dy", "dtheta", "c_xx", "c_xy", "c_xt", "c_yy", "c_yt", "c_tt")
_LANDMARK = ("i", "j", "x", "y", "c_xx", "c_xy", "c_yy")


def victoria_park(path: str | Path) -> Dataset:
    """The data set in `victoria_park.txt`: pose increments, and landmarks in the robot's frame.

    The file has lines `ODOMETRY i j dx dy dθ` and `LANDMARK i j x y`, each followed by the upper
    triangle of its covariance; poses and landmarks share one numbering. Odometry must be one chain,
    and the covariance the same on every line of a kind: it is the noise of the models by default.
    The correction is joint, since a scan has at most two landmarks. Tags follow the landmarks'
    numbers. The data have no ground truth. The file is
    `gtsam.findExampleDataFile("victoria_park.txt")`.

    A scan at the first pose gets a separate row with zero control; then a control of exactly zero
    has no noise.

    Source: Guivant & Nebot, IEEE Trans. Robotics and Automation 17(3), 2001, as with GTSAM.

    Args:
        path: the file.
    Raises:
        ValueError: `path:line: reason` on a line that is malformed or against these rules.
    """
    file = TextFile(path)
    controls: list[list[float]] = []
    poses: dict[int, int] = {}  # index of each pose by its number in the file
    landmark_lines: list[tuple[int, int, int, list[float]]] = []
    odometry_noise = _RepeatedCov(file, 3)
    landmark_noise = _RepeatedCov(file, 2)
    last = -1
    for line, (keyword, *fields) in file:
        if keyword == "ODOMETRY":
            values = file.numbers(line, fields, _ODOMETRY)
            i, j = (file.identity(line, fields[k], "ij"[k]) for k in (0, 1))
            if poses and i != last:
                raise file.error(line, f"odometry starts at {i}, the line before ended at {last}")
            poses.setdefault(i, 0)
            if j in poses:
                raise file.error(line, f"odometry returns to pose {j}")
            poses[j] = len(poses)
            last = j
            controls.append(values[2:5])
            odometry_noise.add(line, values[5:])
        elif keyword == "LANDMARK":
            values = file.numbers(line, fields, _LANDMARK)
            i, j = (file.identity(line, fields[k], "ij"[k]) for k in (0, 1))
            landmark_lines.append((line, i, j, values[2:4]))
            landmark_noise.add(line, values[4:])
        else:
            raise file.error(line, f"unknown keyword {keyword!r}")
    if not controls or not landmark_lines:
        raise file.end_error(f"no {'LANDMARK' if controls else 'ODOMETRY'} line in the file")

    _check_landmark_lines(file, poses, landmark_lines)
    at_start = any(poses[i] == 0 for _, i, _, _ in landmark_lines)
    if at_start:
        controls.insert(0, [0.0, 0.0, 0.0])
    names = tuple(sorted({j for _, _, j, _ in landmark_lines}))
    tag_of = {name: tag for tag, name in enumerate(names)}
    first = 0 if at_start else 1
    noise = _zero_at_rest(odometry_noise.cov) if at_start else odometry_noise.cov
    time = np.arange(first, first + len(controls), dtype=np.float64)
    measurements = (
        [poses[i] for _, i, _, _ in landmark_lines],
        [tag_of[j] for _, _, j, _ in landmark_lines],
        [z for _, _, _, z in landmark_lines],
    )
    return Dataset(
        name="victoria_park",
        log=Log.from_streams((time, controls), measurements, as_recorded, time),
        time=time,
        motion=PoseIncrement(noise),
        sensor=RelativePosition(landmark_noise.cov),
        tags=names,
        filter_options={"correction": "joint"},
        source=_VICTORIA_PARK_SOURCE,
    )


class _RepeatedCov:
    """A covariance that each line repeats as its upper triangle."""

    def __init__(self, file: TextFile, size: int) -> None:
        self.file = file
        self.triangle: list[float] = []
        self.cov: NDArray[np.float64] = np.zeros((size, size))

    def add(self, line: int, triangle: list[float]) -> None:
        """Take the covariance of a line; raises ValueError unless it equals earlier ones."""
        if self.triangle and triangle != self.triangle:
            raise self.file.error(line, "the covariance differs from that of earlier lines")
        if not self.triangle:
            self.triangle = triangle
            upper = np.triu_indices(len(self.cov))
            self.cov[upper] = triangle
            self.cov.T[upper] = triangle
            try:
                require("noise", self.cov, covariance(len(self.cov)))
            except InvalidField as problem:
                raise self.file.error(line, str(problem)) from problem


def _check_landmark_lines(
    file: TextFile, poses: dict[int, int], landmark_lines: list[tuple[int, int, int, list[float]]]
) -> None:
    """Raise ValueError on a landmark line without a pose, of a pose, or repeated."""
    seen: set[tuple[int, int]] = set()
    for line, i, j, _ in landmark_lines:
        if i not in poses:
            raise file.error(line, f"no odometry leads to pose {i}")
        if j in poses:
            raise file.error(line, f"{j} is a pose, not a landmark")
        if (i, j) in seen:
            raise file.error(line, f"landmark {j} is measured twice from pose {i}")
        seen.add((i, j))


def _zero_at_rest(cov: ArrayLike) -> NoiseCov:
    """A noise covariance that is zero where the control is."""

    def noise(pose: jax.Array, u: jax.Array) -> jax.Array:
        return jnp.where((u == 0).all(), 0.0, jnp.asarray(cov, u.dtype))

    return noise
