"""Motion models, one a file. The conformance tests run over `REGISTRY`."""

from collections.abc import Callable

from jaxslam.motion.ackermann import ackermann
from jaxslam.motion.increment import increment
from jaxslam.motion.odometry import (
    odometry,
    odometry_control,
    odometry_controls,
    odometry_noise,
)
from jaxslam.motion.pose_increment import pose_increment
from jaxslam.motion.substeps import substeps
from jaxslam.motion.unicycle import unicycle
from jaxslam.motion.velocity import velocity, velocity_noise
from jaxslam.protocols import Motion

REGISTRY: dict[str, Callable[..., Motion]] = {
    "ackermann": ackermann,
    "increment": increment,
    "odometry": odometry,
    "pose_increment": pose_increment,
    "unicycle": unicycle,
    "velocity": velocity,
}

__all__ = [
    "REGISTRY",
    "ackermann",
    "increment",
    "odometry",
    "odometry_control",
    "odometry_controls",
    "odometry_noise",
    "pose_increment",
    "substeps",
    "unicycle",
    "velocity",
    "velocity_noise",
]
