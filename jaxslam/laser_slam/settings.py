"""The numbers that laser SLAM is run with."""

from dataclasses import dataclass, fields
from typing import Any, cast

import numpy as np

from jaxslam.core.numbers import check_count

_MAY_BE_ZERO = "fewest", "loop_gap", "submap"


@dataclass(frozen=True)
class Settings:
    """Numbers of laser SLAM; lengths in metres, angles in radians. ValueError if out of range."""

    max_range: float = 25.0
    """ranges from here on are not used"""
    beams: int = 192
    """of a scan at most; of one with more, each second, third … is used"""
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
    """side of a cell of the map; larger where the map would have more than 4,000 cells a side"""

    def __post_init__(self) -> None:
        caller = "laser_slam.Settings"
        for field in fields(self):
            given, default = getattr(self, field.name), cast(Any, field.default)
            if isinstance(default, bool):
                if not isinstance(given, bool):
                    raise ValueError(f"{caller}: {field.name}: expected a bool, got {given!r}")
            elif isinstance(default, int):
                if field.name in _MAY_BE_ZERO and given == 0:
                    continue
                check_count(f"{caller}: {field.name}", given)
            else:
                self._check_numbers(f"{caller}: {field.name}", given, np.shape(default))
        for name in ("max_range", "sigma", "correlation", "jump", "resolution", "odometry_base"):
            if not np.all(np.asarray(getattr(self, name)) > 0):
                raise ValueError(f"{caller}: {name}: expected above 0, got {getattr(self, name)}")
        for name in ("loop_probability", "consistency", "least_inliers", "loop_inliers"):
            if not 0 < getattr(self, name) < 1:
                raise ValueError(f"{caller}: {name}: expected in (0, 1), got {getattr(self, name)}")

    @property
    def scans_of_reference(self) -> int:
        """Scans of a reference, the largest of odometry and loops, which share a program."""
        return max(self.reference, 2 * self.submap + 1)

    @staticmethod
    def _check_numbers(name: str, given: object, shape: tuple[int, ...]) -> None:
        """Raise ValueError unless these are finite numbers of at least 0, as many as expected."""
        try:
            value = np.asarray(given, float)
        except (TypeError, ValueError):
            value = np.full(shape, np.nan)
        if value.shape != shape or not np.all(np.isfinite(value) & (value >= 0)):
            many = f"{shape[0]} numbers" if shape else "a number"
            raise ValueError(f"{name}: expected {many} of at least 0, got {given!r}")
