"""What a reader returns: a recorded log with the models, noise and options to run on it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxslam.protocols import Motion, Sensor
from jaxslam.sensors.suite import Suite
from jaxslam.team import Robot
from jaxslam.types import Log, Scan, check_log


@dataclass(frozen=True, eq=False)
class Dataset:
    """A recorded log and how to filter it; T rows, N landmarks.

        data = jaxslam.datasets.bonn(folder)
        ekf = ekf_slam(data.motion, data.sensor, data.capacity, **data.filter_options)
        trace = jaxslam.run(ekf, data.log, data.pose, data.pose_cov, key)

    Arrays are NumPy's, in float64. Raises ValueError where they do not fit together.
    """

    name: str
    log: Log
    """row t: the control that led to pose t and the scan taken there; a tag is a row of `tags`."""
    time: NDArray[np.float64]
    """(T,) seconds, or the number of the odometry line where the file has no clock."""
    motion: Motion
    sensor: Sensor
    tags: tuple[int, ...]
    """the file's own name of the landmark with tag 0, 1, …, N-1."""
    pose: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    """(3,) where the robot is before the first control: the map's frame starts there."""
    pose_cov: NDArray[np.float64] = field(default_factory=lambda: np.zeros((3, 3)))
    """(3, 3) zero, since the robot's start defines the frame."""
    filter_options: dict[str, Any] = field(default_factory=dict)
    """keyword arguments of `filters.ekf_slam` that belong to the data (update, gate)."""
    landmarks: NDArray[np.float64] | None = None
    """(N, 2) surveyed positions [m] in tag order, in a frame of their own; None where unknown."""
    true_path: NDArray[np.float64] | None = None
    """(T, 3) surveyed pose at each row [m, m, rad], in the frame of `landmarks`; None where
    unknown."""
    dropped: dict[str, int] = field(default_factory=dict)
    """measurements that are in the file and not in the log, counted by reason."""
    corrections: tuple[str, ...] = ()
    """what the reader changed of what the files say, in words."""
    source: str = ""
    """whom to credit."""
    robots: tuple[Robot, ...] = ()
    """of a log of several robots: for `filters.team_slam(data.robots, data.capacity)`. Tags N,
    N+1, … are theirs; `motion` and `sensor` are of the first alone, on the same log."""

    def __post_init__(self) -> None:
        check_log(
            self.name,
            self.log,
            control_size=len(self.motion.controls),
            measurement_size=len(self.sensor.measurements),
            parts=self.sensor.places if isinstance(self.sensor, Suite) else (),
        )
        if np.shape(self.time) != (self.steps,):
            raise ValueError(f"{self.name}: expected {self.steps} times, got {np.shape(self.time)}")
        if np.max(self.log.scan.tag, initial=-1) >= self.capacity + len(self.robots):
            raise ValueError(f"{self.name}: a tag is not below the capacity {self.capacity}")
        if self.landmarks is not None and np.shape(self.landmarks) != (self.capacity, 2):
            raise ValueError(
                f"{self.name}: expected landmarks of shape ({self.capacity}, 2), "
                f"got {np.shape(self.landmarks)}"
            )
        if self.true_path is not None and np.shape(self.true_path) != (self.steps, 3):
            raise ValueError(
                f"{self.name}: expected a true path of shape ({self.steps}, 3), "
                f"got {np.shape(self.true_path)}"
            )

    @property
    def steps(self) -> int:
        """T."""
        return int(np.shape(self.log.control)[0])

    @property
    def capacity(self) -> int:
        """N, the number of distinct landmarks."""
        return len(self.tags)

    @property
    def measurements(self) -> int:
        """How many measurements the log holds."""
        return int(np.sum(self.log.scan.valid))


def make_log(
    control: Sequence[Any] | NDArray[np.float64],
    row: Sequence[int] | NDArray[np.int64],
    tag: Sequence[int] | NDArray[np.int64],
    z: Sequence[Any] | NDArray[np.float64],
) -> Log:
    """A log of T controls (T, U) with measurement k, z[k] (Z,) of tag[k], in the scan of row[k].

    Scans keep the order of the measurements and are padded to the fullest one: z 0, tag -1.
    """
    controls, rows = np.asarray(control, np.float64), np.asarray(row, np.int64)
    values = np.asarray(z, np.float64)
    steps = controls.shape[0]
    count = np.bincount(rows, minlength=steps)
    order = np.argsort(rows, kind="stable")
    rows = rows[order]
    place = np.arange(rows.size) - (np.cumsum(count) - count)[rows]
    places = int(np.max(count))
    # Any, because the fields of a Log are declared as what they become under jit.
    padded_z: Any = np.zeros((steps, places, values.shape[1]))
    padded_tag: Any = np.full((steps, places), -1, np.int32)
    valid: Any = np.zeros((steps, places), bool)
    padded_z[rows, place] = values[order]
    padded_tag[rows, place] = np.asarray(tag, np.int32)[order]
    valid[rows, place] = True
    held: Any = controls
    return Log(held, Scan(padded_z, padded_tag, valid))
