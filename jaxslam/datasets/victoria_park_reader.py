"""Reader of the Victoria Park data set as GTSAM distributes it, with known data association."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxslam.core.logs.streams import as_recorded
from jaxslam.core.noise import NoiseCov
from jaxslam.core.numbers import check_covariance
from jaxslam.core.types import Log
from jaxslam.datasets.dataset import Dataset
from jaxslam.datasets.lines import TextFile
from jaxslam.motion import PoseIncrement
from jaxslam.sensors import RelativePosition

SOURCE = (
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
    poses: dict[int, int] = {}
    landmark_lines: list[tuple[int, int, int, list[float]]] = []
    odometry_noise = _Constant(file, 3)
    landmark_noise = _Constant(file, 2)
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
    odometry_file = _unless_still(odometry_noise.cov) if at_start else odometry_noise.cov
    time = np.arange(first, first + len(controls), dtype=np.float64)
    seen = (
        [poses[i] for _, i, _, _ in landmark_lines],
        [tag_of[j] for _, _, j, _ in landmark_lines],
        [z for _, _, _, z in landmark_lines],
    )
    return Dataset(
        name="victoria_park",
        log=Log.from_streams((time, controls), seen, as_recorded, time),
        time=time,
        motion=PoseIncrement(odometry_file),
        sensor=RelativePosition(landmark_noise.cov),
        tags=names,
        filter_options={"correction": "joint"},
        source=SOURCE,
    )


class _Constant:
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
                check_covariance("noise", self.cov, len(self.cov))
            except ValueError as problem:
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


def _unless_still(cov: ArrayLike) -> NoiseCov:
    """A noise covariance that is zero where the control is."""

    def noise(pose: jax.Array, u: jax.Array) -> jax.Array:
        return jnp.where((u == 0).all(), 0.0, jnp.asarray(cov, u.dtype))

    return noise
