"""Motion models, one a file. The conformance tests run over `REGISTRY`."""

from collections.abc import Callable

from jaxslam._public import publish
from jaxslam.core._names import Named
from jaxslam.core.protocols import Motion
from jaxslam.motion._ackermann import Ackermann
from jaxslam.motion._augmented import Augmented
from jaxslam.motion._biased_odometry import BiasedOdometry
from jaxslam.motion._constant_velocity import ConstantVelocity, NoiseDensity
from jaxslam.motion._increments import Increment, PoseIncrement
from jaxslam.motion._odometry import Odometry, OdometryNoise, odometry_control, odometry_controls
from jaxslam.motion._odometry_errors import Corrected
from jaxslam.motion._substeps import Substeps
from jaxslam.motion._unicycle import Unicycle, WhiteNoise
from jaxslam.motion._velocity import Velocity, VelocityNoise

REGISTRY: dict[str, Callable[..., Motion]] = Named(
    {
        "ackermann": Ackermann,
        "biased_odometry": BiasedOdometry,
        "constant_velocity": ConstantVelocity,
        "increment": Increment,
        "odometry": Odometry,
        "pose_increment": PoseIncrement,
        "unicycle": Unicycle,
        "velocity": Velocity,
    }
)

__all__ = [
    "REGISTRY",
    "Ackermann",
    "Augmented",
    "BiasedOdometry",
    "ConstantVelocity",
    "Corrected",
    "Increment",
    "NoiseDensity",
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

publish(__name__)
