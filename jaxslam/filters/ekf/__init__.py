"""EKF-SLAM and its steps, one a file."""
