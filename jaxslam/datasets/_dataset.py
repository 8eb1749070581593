"""The result of a reader: a log with models, noises and options of a filter for it."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from jaxslam.core._validation import log_of
from jaxslam.core.protocols import Motion, Sensor
from jaxslam.core.types import Log
from jaxslam.core.validation import InvalidField, refusals_of, require
from jaxslam.sensors._suite import Suite
from jaxslam.sensors._team import Robot
from jaxslam.simulation.spurious import Spurious


class Parameter(NamedTuple):
    """A number of a data set's models that `fit` can estimate."""

    name: str
    """name with unit, as "motion v [m/s]" or "scale turn" """
    value: float
    group: str
    """"noise" for a standard deviation, else a group of `calibrate`: "mount", "scale", …"""
    place: tuple[str, str]
    """section and key of the settings, whose list holds the parameters of one place in order"""


class Adjustable(NamedTuple):
    """The log and the models of a data set as functions of its parameters."""

    parameters: tuple[Parameter, ...]
    at: Callable[[Float[jax.Array, "P"]], tuple[Log, Motion, Sensor]]
    """values, which may be traced -> log, motion and sensor"""
    cov: Float[np.ndarray, "P P"] | None = None
    """covariance of the fitted values, 0 for others; None if unknown"""

    @property
    def values(self) -> Float[np.ndarray, "P"]:
        """The numbers of all parameters."""
        return np.array([parameter.value for parameter in self.parameters])


@dataclass(frozen=True, eq=False)
class Dataset:
    """A recorded log of T rows and N landmarks, with models and options to filter it.

        data = jaxslam.datasets.bonn(folder)
        ekf = EkfSlam(data.motion, data.sensor, data.capacity, **data.filter_options)
        trace = jaxslam.run(ekf, data.log, data.pose, data.pose_cov, key)

    Arrays are NumPy's, in float64. Raises ValueError if their shapes do not fit together.
    """

    name: str
    log: Log
    """row t: the control that led to pose t, and the scan at pose t; tags are indices of `tags`"""
    time: Float[np.ndarray, "T"]
    """[s], or the number of the odometry line if the file has no times"""
    motion: Motion
    sensor: Sensor
    tags: tuple[int | str, ...]
    """the names in the file of the landmarks with tags 0, 1, …, N-1"""
    pose: Float[np.ndarray, "R"] = field(default_factory=lambda: np.zeros(3))
    """pose of the robot before the first control, the frame of the map; of a motion with further
    numbers in its state, all R = 3 + E"""
    pose_cov: Float[np.ndarray, "R R"] = field(default_factory=lambda: np.zeros((3, 3)))
    """covariance of `pose`; zero if the first pose defines the frame"""
    filter_options: dict[str, Any] = field(default_factory=dict)
    """keyword arguments of `filters.EkfSlam` for this data set (update, gate)"""
    landmarks: Float[np.ndarray, "N 2"] | None = None
    """surveyed positions [m] by tag, in the frame of the survey (`one_frame`); None if unknown"""
    true_path: Float[np.ndarray, "T 3"] | None = None
    """true pose at each row [m, m, rad], in the frame of `landmarks`, NaN in a row without a true
    pose (`true_at`); None if unknown"""
    true_at: Bool[np.ndarray, "T"] | None = None
    """mask of the rows with a true pose; None if all have one"""
    true_paths: Float[np.ndarray, "K T 3"] | None = None
    """true poses of the K robots of a log of several, if known; `true_path` is the first of them"""
    true_paths_at: Bool[np.ndarray, "K T"] | None = None
    """mask of the rows with a true pose by robot; None if all have one"""
    one_frame: bool = False
    """whether `pose`, `landmarks` and `true_path` are in one frame; if not, compare after an
    alignment"""
    slots: int | None = None
    """landmark slots of the filter; None for one per tag"""
    adjustable: Adjustable | None = None
    """log and models as functions of noises and systematic errors, for `datasets.fit`; None if
    they are fixed"""
    dropped: dict[str, int] = field(default_factory=dict)
    """number of measurements in the file that are not in the log, by reason"""
    corrections: tuple[str, ...] = ()
    """descriptions of the changes that the reader made"""
    assumed: tuple[str, ...] = ()
    """defaults that the reader took for settings missing in the files"""
    default_noises: tuple[str, ...] = ()
    """"motion", "sensor": the models whose noise the files do not state, so that it is a default"""
    spurious: Spurious | None = None
    """faults of the sensor that twins of the log have; None: nothing but noise"""
    source: str = ""
    """the publication of the data"""
    robots: tuple[Robot, ...] = ()
    """the robots of a log of several, for `filters.TeamSlam(data.robots, data.capacity)`. They
    have the tags N, N+1, …; `motion` and `sensor` are those of the first robot."""

    def __post_init__(self) -> None:
        slots = self.sensor.places if isinstance(self.sensor, Suite) else ()
        sizes = len(self.motion.controls), len(self.sensor.measurements)
        with refusals_of(self.name):
            require("log", self.log, log_of(*sizes, slots))
            for field, shape in (
                ("time", (self.steps,)),
                ("landmarks", (len(self.tags), 2)),
                ("true_path", (self.steps, 3)),
            ):
                got = np.shape(value := getattr(self, field))
                if got != shape and (value is not None or field == "time"):
                    raise InvalidField(field, f"expected shape {shape}, got {got}")
            if np.max(self.log.scan.tag, initial=-1) >= self.capacity + len(self.robots):
                raise InvalidField("log", f"a tag is not below the capacity {self.capacity}")

    @property
    def steps(self) -> int:
        """The number of rows T."""
        return int(np.shape(self.log.control)[0])

    @property
    def capacity(self) -> int:
        """The number of landmark slots of a filter: `slots`, or else the number of tags N."""
        return len(self.tags) if self.slots is None else self.slots

    @property
    def rows_without_truth(self) -> int:
        """The number of rows whose true pose is not known; T without a true path."""
        if self.true_path is None:
            return self.steps
        return 0 if self.true_at is None else self.steps - int(np.sum(self.true_at))

    @property
    def measurements(self) -> int:
        """The number of measurements in the log."""
        return int(np.sum(self.log.scan.valid))
