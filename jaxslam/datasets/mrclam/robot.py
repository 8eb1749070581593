"""What one robot of MRCLAM recorded, as rows of a log; its models, and its true path."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, TypedDict

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam.core.logs.streams import hold, interpolate_poses
from jaxslam.core.noise import NoiseCov
from jaxslam.core.types import Log
from jaxslam.datasets.mrclam.calibration import RobotCalibration, per_interval, recorded
from jaxslam.datasets.mrclam.files import read_robot, read_truth
from jaxslam.motion import Unicycle
from jaxslam.sensors import RangeBearing

GAP = 0.2
"""Time between lines of the truth beyond which it is unknown between them [s]."""
START_COV = np.diag([0.01, 0.01, 0.03]) ** 2
"""Covariance of a true pose. Of robot 1 of data set 6, headings that two landmarks give agree with
the recorded ones to 0.03 rad, with errors that last for tens of seconds."""


def cut_after(
    odometry: Float[np.ndarray, "K 3"], end: float
) -> tuple[Float[np.ndarray, "J 3"], int]:
    """Odometry without the (0, 0) lines at its end that are later than `end`, and their number.

    A recorder that goes on after the robot has stopped writes such lines. The first of them stays,
    so that the robot stands still from there on.
    """
    moving = np.flatnonzero(odometry[:, 1:].any(axis=1) | (odometry[:, 0] <= end))
    keep = min(int(moving[-1]) + 2 if moving.size else 1, len(odometry))
    return odometry[:keep], len(odometry) - keep


def true_poses(
    truth: Float[np.ndarray, "K 4"], time: Float[np.ndarray, "T"]
) -> tuple[Float[np.ndarray, "T 3"], Bool[np.ndarray, "T"]]:
    """True poses at some times, linear between lines of the truth, and where they are known.

    They are unknown before the first line, after the last, and between lines more than `GAP` apart.
    """
    clock = truth[:, 0]
    after = np.clip(np.searchsorted(clock, time), 1, max(len(clock) - 1, 1))
    last = np.minimum(after, len(clock) - 1)
    near = clock[last] - clock[after - 1] <= GAP
    known = (time >= clock[0]) & (time <= clock[-1]) & (near | np.isin(time, clock))
    return interpolate_poses(clock, truth[:, 1:], time), known


SOURCE = (
    "K. Y. K. Leung, Y. Halpern, T. D. Barfoot, H. H. T. Liu, The UTIAS multi-robot cooperative "
    "localization and mapping dataset, International Journal of Robotics Research 30(8), 2011"
)
ODOMETRY_DENSITY = (0.01**2, 0.05**2)
"""Variance of travel [m²/s] and heading [rad²/s] per second."""
MEASUREMENT_COV = np.diag([0.15, 0.01]) ** 2
DROPS = ("robot sightings", "unknown barcodes", "repeated in a scan")


class Recorded(NamedTuple):
    """What a robot's files hold, corrected where a calibration is given."""

    odometry: Float[np.ndarray, "K 3"]
    seen: Float[np.ndarray, "J 4"]
    truth: Float[np.ndarray, "G 4"] | None
    corrections: tuple[str, ...]


class TrueFields(TypedDict, total=False):
    """The fields of a data set about true paths, and the start."""

    true_path: Float[np.ndarray, "T 3"]
    true_at: Bool[np.ndarray, "T"]
    true_paths: Float[np.ndarray, "R T 3"]
    true_paths_at: Bool[np.ndarray, "R T"]
    pose: Float[np.ndarray, "3"]
    pose_cov: Float[np.ndarray, "3 3"]
    one_frame: bool


def read_lines(folder: Path, robot: int, calibration: RobotCalibration | None) -> Recorded:
    """The lines of a robot, corrected, with its true path and what was changed, in words."""
    odometry, seen = read_robot(folder, robot)
    truth, corrections = read_truth(folder, robot), []
    if truth is not None:
        odometry, cut = cut_after(odometry, truth[-1, 0])
        if cut:
            corrections.append(
                f"{cut:,} odometry lines (0, 0) of robot {robot} after its true path were left out"
            )
    odometry, seen = recorded(odometry, seen, calibration)
    return Recorded(odometry, seen, truth, tuple(corrections))


def models_of(calibration: RobotCalibration | None) -> tuple[Unicycle, RangeBearing]:
    """The motion model and the sensor of a robot, calibrated or as recorded."""
    if calibration is None:
        return Unicycle(white_noise(*ODOMETRY_DENSITY)), RangeBearing(MEASUREMENT_COV)
    sensor = RangeBearing(calibration.measurement_cov(), mount=calibration.mount)
    return Unicycle(calibration.odometry_cov()), sensor


def true_fields(files: Sequence[Recorded], time: Float[np.ndarray, "T"]) -> TrueFields:
    """The true paths, and the start; nothing where no path is known."""
    if files[0].truth is None:
        return {}
    paths, known = true_poses(files[0].truth, time)
    found: TrueFields = {"true_path": paths, "true_at": known}
    if len(files) > 1 and all(own.truth is not None for own in files):
        each = [true_poses(own.truth, time) for own in files if own.truth is not None]
        found["true_paths"] = np.stack([path for path, _ in each])
        found["true_paths_at"] = np.stack([at for _, at in each])
    if known[0]:
        found |= {"pose": paths[0], "pose_cov": START_COV, "one_frame": True}
    return found


def white_noise(v: float, omega: float) -> NoiseCov:
    """White noise of (v, ω) with covariance density/Δt, so that time steps can be divided.

    v [m²/s], omega [rad²/s]: the variance of travel and heading per second. Where Δt = 0 it is 0.
    """

    def noise_cov(pose: jax.Array, u: jax.Array) -> jax.Array:
        density = jnp.stack([jnp.asarray(v, u.dtype), jnp.asarray(omega, u.dtype)])
        return per_interval(density, u[2])

    return noise_cov


def log_of(
    odometry: Float[np.ndarray, "K 3"],
    time: Float[np.ndarray, "T"],
    row: Int[np.ndarray, "J"] | list[int],
    tag: Int[np.ndarray, "J"] | list[int],
    z: Float[np.ndarray, "J Z"],
) -> Log:
    """The log of odometry (t, v, ω) and of measurements in some rows."""
    return Log.from_streams((odometry[:, 0], odometry[:, 1:]), (time[row], tag, z), hold, time)


def associated(
    seen: Float[np.ndarray, "J 4"],
    time: Float[np.ndarray, "T"],
    subject_of: dict[int, int],
    names: tuple[int, ...],
) -> tuple[list[int], list[int], list[int], dict[str, int]]:
    """Row, tag and index of the measurements kept, and the number of dropped ones by reason.

    names: the subjects, landmarks first; their tags are their indices in the list.
    """
    tag_of = {name: tag for tag, name in enumerate(names)}
    dropped = dict.fromkeys(DROPS, 0)
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
