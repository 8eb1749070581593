"""EKF-SLAM of several robots in one joint state."""
