"""EKF-SLAM with delayed initialization, for bearing-only and range-only sensors."""
