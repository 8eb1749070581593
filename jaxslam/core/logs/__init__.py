"""Logs from tables of odometry and measurements, whose streams have times of their own."""
