"""The record of a laser log."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam.types import Beams


@dataclass(frozen=True, eq=False)
class LaserLog:
    """A laser log: K scans of at most B beams, T lines of raw odometry; poses are the robot's."""

    name: str
    source: str
    laser: str
    """the kind of the lines that hold the scans, as FLASER"""
    placed: bool
    """whether these have poses: else `corrected` is zero"""
    time: Float[np.ndarray, "K"]
    """[s] at which each scan was taken; may repeat where the file has few digits"""
    beams: Beams
    """with leading K, in the frame of the laser; shorter scans are padded by beams that are not
    valid"""
    corrected: Float[np.ndarray, "K 3"]
    """the robot's pose that stands in the line of the scan: a reference, not the truth"""
    raw: Float[np.ndarray, "K 3"]
    """raw odometry at each scan"""
    odometry_known: Bool[np.ndarray, "K"]
    """whether raw odometry tells of the step from the scan before; where not, it stands still. True
    for the first"""
    row: Int[np.ndarray, "K"]
    """the last line of raw odometry before each scan, as an index of `odometry`; -1 where there is
    none before"""
    odometry: Float[np.ndarray, "T 3"]
    odometry_time: Float[np.ndarray, "T"]
    """[s] as logged: 0 or anything in a line that sets the odometry"""
    max_range: float
    """[m]: ranges from here on are of beams that met nothing, and are set to it"""
    mount: Float[np.ndarray, "3"]
    """the laser's pose on the robot"""
    dropped: Mapping[str, int]
    """what the reader left out, by kind"""
    corrections: tuple[str, ...]
    """what it changed, in words"""
