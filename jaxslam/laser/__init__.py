"""Laser scans: grids and rays, matching, laser SLAM, segments, topological maps."""
