"""The record of a laser log, and its mount: what the readers of laser logs share."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam.core.types import Beams


@dataclass(frozen=True, eq=False)
class LaserLog:
    """A laser log: K scans of at most B beams, T poses of raw odometry; poses are of the robot."""

    name: str
    source: str
    laser: str
    """kind of the lines of the scans, as FLASER, or their topic"""
    placed: bool
    """whether the scans have poses in the file; else `corrected` is zero"""
    time: Float[np.ndarray, "K"]
    """stamp of each scan [s]; may repeat if the file has few digits"""
    beams: Beams
    """with leading K, in the frame of the laser; shorter scans are padded by invalid beams"""
    corrected: Float[np.ndarray, "K 3"]
    """pose of the robot in the file: a reference, not the truth"""
    raw: Float[np.ndarray, "K 3"]
    """raw odometry at each scan"""
    odometry_known: Bool[np.ndarray, "K"]
    """whether the odometry from the previous scan is known, else zero; True for the first"""
    row: Int[np.ndarray, "K"]
    """the last odometry before each scan, as an index of `odometry`; -1 if none"""
    odometry: Float[np.ndarray, "T 3"]
    odometry_time: Float[np.ndarray, "T"]
    """stamp as logged [s]; arbitrary in a line of CARMEN that sets the odometry"""
    max_range: float
    """range of beams without a return [m]"""
    mount: Float[np.ndarray, "3"]
    """pose of the laser on the robot"""
    dropped: Mapping[str, int]
    """number of lines, messages, scans or beams left out, by kind"""
    corrections: tuple[str, ...]
    """descriptions of the changes that the reader made"""


MOUNT_TOLERANCE = 0.01, np.deg2rad(0.5)
"""Largest difference of the mount within a log [m], [rad]."""


def differs_from_zero(pose: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """The mask of the poses that are not the identity, with tolerance `MOUNT_TOLERANCE`."""
    far = np.hypot(pose[:, 0], pose[:, 1]) > MOUNT_TOLERANCE[0]
    return np.asarray(far | (np.abs(pose[:, 2]) > MOUNT_TOLERANCE[1]))


def pose_text(pose: Float[np.ndarray, "3"]) -> str:
    """A pose as text, in metres and degrees."""
    x, y, heading = pose
    return f"({x:.4g}, {y:.4g}, {np.rad2deg(heading):.4g}°)"


def wrapped_path(path: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """The poses with θ in (-π, π]."""
    return np.column_stack([path[:, :2], np.angle(np.exp(1j * path[:, 2]))])
