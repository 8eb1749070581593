"""Public logs by `laser_slam.solve`, beside raw odometry and laser odometry."""

import time
from pathlib import Path

import numpy as np

from benchmarks.gate import Metric
from benchmarks.real_data import DATA
from jaxslam import datasets, laser_slam, metrics
from jaxslam.laser_slam import LoopOutcome
from jaxslam.results import plot

LOGS = ("intel", "csail", "edmonton", "freiburg-101")
FIGURES = Path(__file__).parents[1] / "figures"
METRES = (1.0, 2.0, 5.0, 10.0)
"""Lengths of path of the relations, of each as many as there are scans."""


def measure(names: tuple[str, ...] = LOGS, draw: bool = True) -> list[Metric]:
    print(
        "log           path             relation error [m]  heading [deg]   "
        "of 1 m   2 m    5 m   10 m"
    )
    found: list[Metric] = []
    for name in names:
        try:
            log = datasets.carmen(DATA / "carmen" / f"{name}-corrected.log")
        except ValueError as problem:
            print(f"{name}: left out: {problem}")
            continue
        began, busy = time.perf_counter(), time.process_time()
        solved = laser_slam.solve(log)
        seconds, busy = time.perf_counter() - began, time.process_time() - busy
        means = {}
        paths = {
            "raw odometry": solved.raw,
            "laser odometry": solved.odometry,
            "laser SLAM": solved.poses,
        }
        for what, path in paths.items():
            errors = [metrics.rpe(log.corrected, path, metres=m) for m in METRES]
            every = np.concatenate([each.translation for each in errors])
            turn = np.degrees(np.concatenate([each.rotation for each in errors]).mean())
            means[what] = every.mean()
            each = "  ".join(f"{one.translation.mean():5.3f}" for one in errors)
            print(f"{name:12}  {what:15}  {every.mean():18.3f}  {turn:13.2f}   {each}", flush=True)
        score = laser_slam.closure_score(solved, log.corrected)
        tally = {o.name.lower(): int((solved.loops.outcome == o).sum()) for o in LoopOutcome}
        told = ", ".join(f"{count} {outcome}" for outcome, count in tally.items())
        print(f"{name:12}  loops: {len(solved.loops.outcome)} matched, {told}")
        stages = ", ".join(f"{stage} {value:.1f}" for stage, value in solved.seconds.items())
        print(f"{name:12}  seconds: {stages}", flush=True)
        limit = 0.05 if name == "intel" else np.inf
        ratio = solved.chi2 / max(solved.dof, 1)
        off = f"σ too {'small' if ratio > 1 else 'large'} by {max(ratio, 1 / ratio) ** 0.5:.1f}"
        found += [
            Metric(f"{name}, relation error to 10 m [m]", means["laser SLAM"], high=limit),
            Metric(f"{name}, of raw odometry [m]", means["raw odometry"]),
            Metric(
                f"{name}, chi2 / degrees of freedom",
                ratio,
                low=0.5,
                high=2.0,
                note=off,
            ),
            Metric(f"{name}, processor seconds, all cores", busy),
            Metric(f"{name}, precision of loops", score.precision, low=0.98),
            Metric(f"{name}, recall of revisits", score.recall, note=f"of {score.revisits}"),
            Metric(
                f"{name}, compilation included [s]",
                seconds,
                high=60.0 if name == "intel" else np.inf,
            ),
        ]
        if draw and name == "intel":
            plot.maps_before_after(solved).savefig(FIGURES / "laser_slam_intel.png")
    return found
