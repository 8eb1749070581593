"""Laser scans: grids and rays, matching, laser SLAM, segments, topological maps."""

from jaxslam.laser import features, grids, laser_slam, matching, topology

__all__ = ["features", "grids", "laser_slam", "matching", "topology"]
