"""Public logs by `laser_slam.solve`, beside raw odometry and laser odometry."""

import time
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.gate import Metric
from benchmarks.real_data import DATA
from jaxslam import datasets, laser_slam, metrics
from jaxslam.laser_slam import LoopOutcome
from jaxslam.math import numpy_poses as poses
from jaxslam.results import plot

LOGS = ("intel", "csail", "edmonton", "freiburg-101")
FIGURES = Path(__file__).parents[1] / "figures"
METRES = (1.0, 2.0, 5.0, 10.0)
"""Lengths of path of the relations, of each as many as there are scans."""


def off_the_file(
    solved: laser_slam.Solved, reference: np.ndarray
) -> list[tuple[int, int, float, float]]:
    """The loops that were kept and that the file's poses contradict: both scans, [m] and [°]."""
    loops = solved.loops
    kept = loops.outcome == LoopOutcome.KEPT
    first, second = loops.first[kept], loops.second[kept]
    off = poses.between(loops.z[kept], poses.between(reference[first], reference[second]))
    far, turn = np.hypot(*off[:, :2].T), np.rad2deg(off[:, 2])
    wrong = (far >= 0.5) | (np.abs(turn) >= 5.0)
    rows = zip(*(part[wrong].tolist() for part in (first, second, far, turn)), strict=True)
    return list(rows)


def fit_by_turn(log: datasets.LaserLog, j: int) -> dict[float, float]:
    """The median distance of a scan's points to the nearest of the scan before [m], with the scan
    at its corrected pose and turned by some degrees, at the best of 25 places within 0.2 m."""
    points = laser_slam.scans_of(log, laser_slam.Settings()).points
    before, own = (np.asarray(points.position)[i][np.asarray(points.valid)[i]] for i in (j - 1, j))
    tree, z = cKDTree(before), poses.between(log.corrected[j - 1], log.corrected[j])
    found = {}
    for turn in np.arange(-12.0, 12.5, 0.5):
        angle = z[2] + np.deg2rad(turn)
        turned = own @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        found[float(turn)] = min(
            float(np.median(tree.query(turned + z[:2] + [x, y])[0]))
            for x in np.linspace(-0.2, 0.2, 5)
            for y in np.linspace(-0.2, 0.2, 5)
        )
    return found


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
        others = off_the_file(solved, log.corrected)
        for i, j, off, turn in others:
            told = f"{off:.2f} m and {abs(turn):.1f} deg off the file"
            print(f"{name:12}  loop of scans {i} and {j}: {told}")
        after = {k for _, j, *_ in others for k in (j, j + 1) if k < len(log.corrected)}
        for j in sorted(after):
            fits = fit_by_turn(log, j)
            least = min(fits, key=lambda turn: fits[turn])
            told = f"{fits[0.0]:.3f} m at the file's heading, {fits[least]:.3f} m"
            print(
                f"{name:12}  scan {j} on {j - 1}: median distance {told} turned by {least:.1f} deg"
            )
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
