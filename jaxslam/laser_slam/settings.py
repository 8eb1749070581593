"""The numbers that laser SLAM is run with."""

from dataclasses import dataclass, fields

from jaxslam.core.numbers import check_count, check_positive

_MAY_BE_ZERO = "fewest", "loop_gap", "submap"


@dataclass(frozen=True)
class Settings:
    """Numbers of laser SLAM; lengths in metres. ValueError on counts below 1, lengths not above 0.

    Counts that may be 0 are `fewest`, `loop_gap` and `submap`.
    """

    max_range: float = 25.0
    """ranges from here on are not used"""
    beams: int = 192
    """of a scan at most; of one with more, each second, third … is used"""
    fewest: int = 20
    """a scan with fewer points is left out"""
    sigma: float = 0.02
    """least standard deviation of a point's distance from a wall"""
    jump: float = 3.0
    """a step of raw odometry longer than this is taken to be an error"""
    reference: int = 8
    """keyframes that a scan is matched with; 1 is scan to scan"""
    key_distance: float = 0.4
    """a scan farther than this from the last keyframe is one"""
    loop_gap: int = 20
    """keyframes between the two ends of a loop, at least"""
    submap: int = 5
    """keyframes before and after its middle in a submap that loops are closed with"""
    submap_every: int = 3
    """keyframes from the middle of a submap to that of the next"""
    rounds: int = 2
    """of candidates, matches and optimization"""
    resolution: float = 0.05
    """side of a cell of the map; larger where the map would have more than 4,000 cells a side"""

    def __post_init__(self) -> None:
        caller = "laser_slam.Settings"
        for field in fields(self):
            given = getattr(self, field.name)
            if isinstance(field.default, float):
                check_positive(caller, **{field.name: given})
            elif field.name not in _MAY_BE_ZERO or given != 0:
                check_count(f"{caller}: {field.name}", given)

    @property
    def scans_of_reference(self) -> int:
        """Scans of a reference, the largest of odometry and loops, which share a program."""
        return max(self.reference, 2 * self.submap + 1)
