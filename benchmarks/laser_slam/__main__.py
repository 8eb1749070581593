"""Laser SLAM: `python -m benchmarks.laser_slam [--part logs|office] [--runs N]`.

`logs`: four public logs, from raw odometry and scans alone, scored by their corrected poses: mean
translational error of relations along 1, 2, 5 and 10 m of path, χ² of the graph, precision and
recall of the loops, seconds. `office`: NEES of laser odometry's covariance in a simulated office,
of a match, of the chain of matches, of an EKF that these drive (a campaign), and of the graph with
loops.
"""

from benchmarks.gate import Metric, alone
from benchmarks.laser_slam import logs, office

PARTS = ("logs", "office")


def measure(quick: bool = False, part: str | None = None, runs: int | None = None) -> list[Metric]:
    metrics = []
    if part in (None, "logs"):
        metrics += logs.measure(("intel",) if quick else logs.LOGS)
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
