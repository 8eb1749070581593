"""EKF-SLAM and its steps."""
