"""Laser SLAM: `python -m benchmarks.laser_slam [--part logs|size|office] [--runs N]`.

`logs`: public logs, from raw odometry and scans alone: errors of the relations of the Freiburg
benchmark (Kümmerle et al. 2009), which were checked by hand, and the share of them in the 95 %
ellipse of the graph's own covariance; errors to the poses in the files along 1, 2, 5 and 10 m of
path, precision and recall of the loops; χ² of the graph, seconds. `size`: a log of 4,791 scans,
warm, and one of 20,000: time and memory. `office`: NEES of laser odometry's covariance in a
simulated office, of a match, of the chain of matches, of an EKF that these drive (a campaign), and
of the graph with loops.
"""

from benchmarks.gate import Metric, alone
from benchmarks.laser_slam import logs, office, size

PARTS = ("logs", "size", "office")


def measure(quick: bool = False, part: str | None = None, runs: int | None = None) -> list[Metric]:
    metrics = []
    if part in (None, "logs"):
        metrics += logs.measure(("intel",) if quick else tuple(logs.LOGS))
    if part in (None, "size") and not quick:
        metrics += size.measure()
    if part in (None, "office"):
        metrics += office.measure(runs or (3 if quick else 100))
    return metrics


if __name__ == "__main__":
    raise SystemExit(
        alone(
            "laser_slam",
            measure,
            part={"choices": PARTS},
            runs={"type": int, "help": "of the office"},
        )
    )
