"""The robots of a team, and the layout of their controls, scans and states.

`filters.TeamSlam` is their filter, and `TeamWorld` simulates their worlds.
"""

from jaxslam._public import publish
from jaxslam.filters.multi_robot._team import Robot, pose_cross_cov, poses

__all__ = ["Robot", "pose_cross_cov", "poses"]

publish(__name__)
