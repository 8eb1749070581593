"""Laser odometry: steps of raw odometry, scans matched with keyframes, increments for a filter."""
