"""Laser SLAM of public logs and of a simulated office: see `__main__`."""
