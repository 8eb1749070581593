"""Laser SLAM: from the raw odometry and scans of a log to a path, a pose graph and a map."""

from jaxslam._public import publish
from jaxslam.laser.laser_slam._odometry.log_odometry import MatchMotion, match_controls
from jaxslam.laser.laser_slam._odometry.tracking import Odometry
from jaxslam.laser.laser_slam._records import LoopOutcome, Loops, ScanLog, Settings, Solved
from jaxslam.laser.laser_slam._score import (
    ClosureScore,
    closure_score,
    relation_covs,
    relation_nees,
)
from jaxslam.laser.laser_slam._solver import solve

__all__ = [
    "ClosureScore",
    "LoopOutcome",
    "Loops",
    "MatchMotion",
    "Odometry",
    "ScanLog",
    "Settings",
    "Solved",
    "closure_score",
    "match_controls",
    "relation_covs",
    "relation_nees",
    "solve",
]

publish(__name__)
