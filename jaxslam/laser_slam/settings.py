"""The numbers that laser SLAM is run with."""

from dataclasses import dataclass, fields

import numpy as np


@dataclass(frozen=True)
class Settings:
    """Numbers of laser SLAM; lengths in metres, angles in radians. ValueError if out of range."""

    max_range: float = 25.0
    """ranges from here on are not used"""
    beams: int = 180
    """of a scan with more, each second, third … is used"""
    fewest: int = 20
    """a scan with fewer points is left out"""
    sigma: float = 0.02
    """least standard deviation of a point's distance from a wall"""
    correlation: float = 2.0
    """beams that err together: information of a match is divided by it"""
    floor: tuple[float, float, float] = (0.005, 0.005, 0.002)
    """standard deviations of x, y and θ that are added to each match, for what the lines miss"""
    odometry_base: tuple[float, float] = (0.03, 0.02)
    """standard deviation of a step of raw odometry, [m] and [rad]"""
    odometry_share: tuple[float, float, float] = (0.10, 0.15, 0.05)
    """and more of it: position by distance, heading by turn, heading by distance [rad/m]"""
    jump: float = 3.0
    """a step of raw odometry longer than this is taken to be an error"""
    reference: int = 8
    """keyframes that a scan is matched with; 1 is scan to scan"""
    key_distance: float = 0.4
    """a scan farther than this from the last keyframe is one"""
    key_turn: float = 0.35
    """or turned by more than this"""
    least_inliers: float = 0.4
    """share of a scan's points that lie on the walls of the reference, for a match in odometry"""
    loop_inliers: float = 0.65
    """and for a loop"""
    loop_gap: int = 20
    """keyframes between the two ends of a loop, at least"""
    loop_reach: float = 3.0
    """distance between two places that share walls"""
    loop_probability: float = 0.999
    """of the ellipse in which a place is searched"""
    submap: int = 5
    """keyframes before and after its middle in a submap that loops are closed with"""
    submap_every: int = 3
    """keyframes from the middle of a submap to that of the next"""
    rounds: int = 2
    """of candidates, matches and optimization"""
    candidates: int = 3
    """submaps that a keyframe is matched with in a round, at most"""
    appearance: bool = True
    """whether candidates are sought by descriptors as well"""
    consistency: float = 0.999
    """probability below which two loops agree"""
    resolution: float = 0.05
    """side of a cell of the map"""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = np.asarray(getattr(self, field.name))
            if field.name == "appearance":
                continue
            if not np.all(np.isfinite(value)) or np.any(value < 0):
                raise ValueError(f"laser_slam.Settings: {field.name} is {value}")
        for name in ("max_range", "beams", "sigma", "correlation", "jump", "reference", "rounds"):
            if not getattr(self, name) > 0:
                raise ValueError(
                    f"laser_slam.Settings: expected {name} above 0, got {getattr(self, name)}"
                )
        for name in ("loop_probability", "consistency", "least_inliers", "loop_inliers"):
            if not 0 < getattr(self, name) < 1:
                raise ValueError(
                    f"laser_slam.Settings: expected {name} in (0, 1), got {getattr(self, name)}"
                )
