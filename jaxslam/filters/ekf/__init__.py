"""EKF-SLAM: the Kalman-type filter on a joint state, and its steps, one a file."""
