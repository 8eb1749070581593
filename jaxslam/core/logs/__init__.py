"""Logs from tables of odometry and measurements, whose streams have separate times."""
