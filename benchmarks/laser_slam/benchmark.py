"""Laser SLAM of public logs, of long logs, and in a simulated office.

Public logs, from raw odometry and scans alone: errors of the relations of the Freiburg benchmark
(Kümmerle et al. 2009), which were checked by hand, and the share of them in the 95 % ellipse of the
graph's own covariance; errors to the poses in the files along 1, 2, 5 and 10 m of path, precision
and recall of the loops; χ² of the graph, seconds. Long logs: one of 4,791 scans, warm, and one of
20,000: time and memory. Office: NEES of laser odometry's covariance, of a match, of the chain of
matches, of an EKF that these drive (a campaign), and of the graph with loops.
"""

from benchmarks.gate import Metric
from benchmarks.laser_slam import logs, office, size


def measure(quick: bool = False) -> list[Metric]:
    long = [] if quick else size.measure()
    return logs.measure(quick) + long + office.measure(3 if quick else 100)
