"""EKF-SLAM with sensors that see a landmark in part, initialized late."""
