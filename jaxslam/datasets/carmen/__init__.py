"""Laser logs of CARMEN: lines of the format, odometry and what sets it, the log."""
