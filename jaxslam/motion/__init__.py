"""Motion models, one a file. `REGISTRY` is what the conformance suite runs over."""

from collections.abc import Callable

from jaxslam.motion.increment import increment
from jaxslam.motion.pose_increment import pose_increment
from jaxslam.motion.unicycle import unicycle
from jaxslam.protocols import Motion

REGISTRY: dict[str, Callable[..., Motion]] = {
    "increment": increment,
    "pose_increment": pose_increment,
    "unicycle": unicycle,
}

__all__ = ["REGISTRY", "increment", "pose_increment", "unicycle"]
