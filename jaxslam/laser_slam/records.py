"""The records of laser SLAM: its log, the loops that were tried, the result."""

from enum import IntEnum
from typing import NamedTuple, Protocol

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam.graphs import Graph
from jaxslam.grids import Grid
from jaxslam.types import Beams


class LogOfScans(Protocol):
    """What is read of a log: `datasets.LaserLog` and `ScanLog` have it."""

    @property
    def time(self) -> Float[np.ndarray, "K"]:
        """[s] of each scan."""

    @property
    def beams(self) -> Beams:
        """The scans, with leading K."""

    @property
    def raw(self) -> Float[np.ndarray, "K 3"]:
        """Raw odometry at each scan: the robot's pose."""

    @property
    def max_range(self) -> float:
        """[m] from which on a beam met nothing."""

    @property
    def mount(self) -> Float[np.ndarray, "3"] | tuple[float, float, float]:
        """Pose of the laser on the robot."""

    @property
    def odometry_known(self) -> Bool[np.ndarray, "K"] | None:
        """Whether odometry was logged since the scan before; None: at all scans."""


class ScanLog(NamedTuple):
    """K scans with the raw odometry at each."""

    time: Float[np.ndarray, "K"]
    """[s]"""
    beams: Beams
    """with leading K"""
    raw: Float[np.ndarray, "K 3"]
    """pose of the robot by raw odometry; only its increments matter"""
    max_range: float
    """[m] from which on a beam met nothing"""
    mount: Float[np.ndarray, "3"] | tuple[float, float, float] = (0.0, 0.0, 0.0)
    """pose of the laser on the robot"""
    odometry_known: Bool[np.ndarray, "K"] | None = None
    """whether odometry was logged since the scan before; None: at all scans"""


class LoopOutcome(IntEnum):
    """What became of a candidate of a loop."""

    KEPT = 0
    """an edge of the graph"""
    POOR = 1
    """too few points on the walls of the other place"""
    AMBIGUOUS = 2
    """another pose within the window is nearly as good"""
    INCONSISTENT = 3
    """disagrees with the loops that are kept (Mangelson et al. 2018)"""
    DOUBTED = 4
    """the optimized graph disagrees by more than the probability allows"""


class Loops(NamedTuple):
    """The candidates of loops that were matched, M of them."""

    first: Int[np.ndarray, "M"]
    """the scan in whose frame z is"""
    second: Int[np.ndarray, "M"]
    z: Float[np.ndarray, "M 3"]
    """pose of the second in the frame of the first"""
    cov: Float[np.ndarray, "M 3 3"]
    """of the end of z, in the frame of the second"""
    score: Float[np.ndarray, "M"]
    """share of the points on walls of the other place"""
    appearance: Int[np.ndarray, "M"]
    """1 where the candidate was found by its looks, 0 where by its place"""
    outcome: Int[np.ndarray, "M"]
    """a `LoopOutcome`"""


class Solved(NamedTuple):
    """The result of laser SLAM; all arrays are NumPy's, all poses the robot's, in `raw`'s frame."""

    time: Float[np.ndarray, "K"]
    poses: Float[np.ndarray, "K 3"]
    """of every scan, after closing"""
    odometry: Float[np.ndarray, "K 3"]
    """of every scan, by laser odometry alone"""
    raw: Float[np.ndarray, "K 3"]
    """of every scan, by raw odometry"""
    cov: Float[np.ndarray, "K 3 3"]
    """of (x, y, θ) of `poses`, relative to the first"""
    doubted: Bool[np.ndarray, "K"]
    """scans whose match is in doubt (`laser_odometry`)"""
    keyframe: Int[np.ndarray, "N"]
    """scans that are poses of the graph"""
    base: Int[np.ndarray, "K"]
    """row in the graph of the keyframe that each scan is relative to; of a keyframe, its own"""
    z: Float[np.ndarray, "K 3"]
    """pose of each scan in the frame of that keyframe; zero for keyframes"""
    z_cov: Float[np.ndarray, "K 3 3"]
    """of the end of `z`; zero for keyframes"""
    graph: Graph
    """the optimum; `pose_id` is the index of the scan"""
    start: Graph
    """the same graph at the poses of laser odometry"""
    loops: Loops
    map: Grid
    map_before: Grid
    """of the poses of laser odometry"""
    counts: dict[str, int]
    """what was used and what was left out"""
    chi2: float
    """of the graph, without a kernel"""
    dof: int
    seconds: dict[str, float]
    """by stage, compilation included"""
