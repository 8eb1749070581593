"""EKF-SLAM of several robots in one joint state."""

from jaxslam.filters.multi_robot import team

__all__ = ["team"]
