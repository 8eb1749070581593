"""The records of laser SLAM: the numbers it is run with, its log, the loops tried, the result."""

from dataclasses import dataclass, fields
from enum import IntEnum
from typing import NamedTuple, Protocol

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam.core.types import Beams
from jaxslam.core.validation import at_least, positive, refusals_of, require
from jaxslam.graphs import Graph
from jaxslam.laser.grids import Grid

_MAY_BE_ZERO = "fewest", "loop_gap", "submap"


@dataclass(frozen=True)
class Settings:
    """Numbers of laser SLAM; lengths in metres. ValueError on counts below 1, lengths not above 0.

    Counts that may be 0 are `fewest`, `loop_gap` and `submap`. The defaults were chosen on the logs
    intel, edmonton, freiburg-101 and CSAIL.
    """

    max_range: float = 25.0
    """ranges from this one on are not used"""
    beams: int = 192
    """largest number of beams of a scan; of a scan with more each second, third … is used"""
    fewest: int = 20
    """a scan with fewer points is left out"""
    sigma: float = 0.02
    """least standard deviation of a point's distance from a wall"""
    jump: float = 3.0
    """a longer step of raw odometry is assumed to be an error; so is a step that is impossible by
    its speed or turn rate, whatever its length"""
    reference: int = 8
    """keyframes that a scan is matched with; 1 is scan to scan"""
    key_distance: float = 0.4
    """distance from the last keyframe above which a scan is a keyframe"""
    loop_gap: int = 20
    """keyframes between the two ends of a loop, at least"""
    submap: int = 5
    """keyframes before and after its middle in a submap that loops are closed with"""
    submap_every: int = 3
    """keyframes from the middle of a submap to the middle of the next"""
    rounds: int = 2
    """number of rounds of candidates, matches and optimization"""
    resolution: float = 0.05
    """side of a cell of the map; larger where the map would have more than 4,000 cells a side"""

    def __post_init__(self) -> None:
        with refusals_of("laser_slam.Settings"):
            for field in fields(self):
                least = at_least(0 if field.name in _MAY_BE_ZERO else 1)
                check = positive if isinstance(field.default, float) else least
                require(field.name, getattr(self, field.name), check)

    @property
    def scans_of_reference(self) -> int:
        """Number of scans of a reference: odometry and loops share a program."""
        return max(self.reference, 2 * self.submap + 1)


class LogOfScans(Protocol):
    """The parts of a log that laser SLAM reads: `datasets.LaserLog` and `ScanLog` have them."""

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
    """The outcome of a candidate of a loop."""

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
    """covariance of the end of z, in the frame of the second"""
    score: Float[np.ndarray, "M"]
    """share of the points on walls of the other place"""
    appearance: Int[np.ndarray, "M"]
    """1 for a candidate by appearance, 0 for a candidate by place"""
    outcome: Int[np.ndarray, "M"]
    """a `LoopOutcome`"""


class Solved(NamedTuple):
    """The result of laser SLAM; all arrays are NumPy's, all poses the robot's, in `raw`'s frame."""

    time: Float[np.ndarray, "K"]
    poses: Float[np.ndarray, "K 3"]
    """pose of every scan, after closing"""
    odometry: Float[np.ndarray, "K 3"]
    """pose of every scan by laser odometry alone"""
    raw: Float[np.ndarray, "K 3"]
    """pose of every scan by raw odometry"""
    cov: Float[np.ndarray, "K 3 3"]
    """covariance of (x, y, θ) of `poses`, relative to the first"""
    doubted: Bool[np.ndarray, "K"]
    """scans whose match is in doubt (`laser_odometry`)"""
    keyframe: Int[np.ndarray, "N"]
    """scans that are poses of the graph"""
    base: Int[np.ndarray, "K"]
    """row in the graph of each scan's keyframe; for a keyframe, its own row"""
    z: Float[np.ndarray, "K 3"]
    """pose of each scan in the frame of its keyframe; zero for keyframes"""
    z_cov: Float[np.ndarray, "K 3 3"]
    """covariance of the end of `z`; zero for keyframes"""
    graph: Graph
    """optimal graph; `pose_id` is the index of the scan"""
    start: Graph
    """the graph at the poses of laser odometry"""
    loops: Loops
    map: Grid
    """map at `poses`"""
    map_before: Grid
    """map at the poses of laser odometry"""
    counts: dict[str, int]
    """counts of used and unused data"""
    chi2: float
    """χ² of the graph, without a kernel. √(chi2/dof) is the size of the residuals of its edges
    against their σ. It is no factor for `cov`: edges share scans, so their errors are not
    independent"""
    dof: int
    """degrees of freedom of the graph"""
    seconds: dict[str, float]
    """duration of each stage, compilation included"""
