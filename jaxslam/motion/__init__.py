"""Motion models, one a file. The conformance tests run over `REGISTRY`."""

from collections.abc import Callable

from jaxslam.core.protocols import Motion
from jaxslam.motion.ackermann import Ackermann
from jaxslam.motion.increments import Increment, PoseIncrement
from jaxslam.motion.odometry import (
    Odometry,
    OdometryNoise,
    odometry_control,
    odometry_controls,
)
from jaxslam.motion.odometry_errors import Corrected
from jaxslam.motion.substeps import Substeps
from jaxslam.motion.unicycle import Unicycle, WhiteNoise
from jaxslam.motion.velocity import Velocity, VelocityNoise

REGISTRY: dict[str, Callable[..., Motion]] = {
    "ackermann": Ackermann,
    "increment": Increment,
    "odometry": Odometry,
    "pose_increment": PoseIncrement,
    "unicycle": Unicycle,
    "velocity": Velocity,
}

__all__ = [
    "Ackermann",
    "Corrected",
    "Increment",
    "Odometry",
    "OdometryNoise",
    "PoseIncrement",
    "Substeps",
    "Unicycle",
    "Velocity",
    "VelocityNoise",
    "WhiteNoise",
    "odometry_control",
    "odometry_controls",
]
