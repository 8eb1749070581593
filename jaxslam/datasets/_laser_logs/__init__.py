"""Logs of laser scanners: CARMEN files and ROS bags."""
