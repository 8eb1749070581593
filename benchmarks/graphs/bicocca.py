"""Bicocca 25b, with loop closures by appearance: robust kernels beside GTSAM's.

The odometry and the loops are those of `B25b_0.500.g2o`; the true path, in the CSV, has times, the
graph none. Its poses are taken as evenly spaced over the time of the true path: with this the turns
of the odometry are those of the true path, to 0.09 rad in ten steps, and with other spacings they
are not. A loop of the file is false where the true path differs from it by 3 m or 0.5 rad, judged
where the true path has no gap of a second: none is, so that false ones are added, between poses at
random, as many as there are true ones (`worlds.with_false_closures`).

All start at the odometry, and trust it; positions are compared after alignment. GTSAM's graduated
non-convexity has the same threshold, the 99 % quantile of χ² with three degrees of freedom, and its
own Levenberg-Marquardt.
"""

import time

import jax
import numpy as np

from benchmarks.gate import Metric, show
from benchmarks.graphs import peer
from benchmarks.graphs.worlds import with_false_closures
from benchmarks.real_data import DATA
from jaxslam import datasets, graphs, metrics
from jaxslam.graphs._graph import LOOPS
from jaxslam.math import numpy_poses

GRAPH = DATA / "graphs" / "B25b_0.500.g2o"
TRUTH = DATA / "graphs" / "Bicocca_2009-02-25b-GT-extended.csv"
GAP = 1.0
"""[s]"""
NEAR = np.array([3.0, 3.0, 0.5])
"""what a loop may differ from the true path in [m, m, rad]"""
FACTORS = {"relative_pose": graphs.RelativePoseLog()}


def measure(quick: bool = False) -> list[Metric]:
    """Nothing where the graph is absent, or quick."""
    metrics = []
    for share in (0.0, 0.5) if GRAPH.exists() and not quick else ():
        found = compare(share)
        name = f"Bicocca 25b, {share:.0%} false"
        show(name, found)
        ours, theirs = found["truncated"], found["GTSAM's GNC"]
        gap = ours["position RMSE [m]"] / theirs["position RMSE [m]"]
        metrics.append(Metric(f"{name}: position RMSE, truncated / GTSAM's GNC", gap, high=1.05))
        if share:
            metrics.append(Metric(f"{name}: false loops kept", ours["false loops kept"]))
    return metrics


def compare(share: float) -> dict[str, dict[str, float]]:
    """Figures of merit by kernel, without one first, then GTSAM's, and the odometry last; a share
    of the loops is added and false."""
    graph = graphs.starts.odometry(graphs.with_gauge(datasets.read_graph(GRAPH)))
    apart, added = with_false_closures(graph, share)
    truth, seen = true_poses(len(graph.poses))
    table = apart.tables[LOOPS]
    off = numpy_poses.between(*truth[np.asarray(table.who).T]) - np.asarray(table.z)
    off[:, 2] = numpy_poses.wrapped(off[:, 2])
    judged = ~added & seen[np.asarray(table.who)].all(axis=1)
    false = added | (judged & (np.abs(off) > NEAR).any(axis=1))
    true = judged & ~false
    print(
        f"\nBicocca 25b: {len(truth)} poses, {seen.sum()} with a true position, "
        f"{(~added).sum()} loops, {judged.sum()} of them judged, {(false & ~added).sum()} false; "
        f"{added.sum()} false ones added"
    )
    plan, found = graphs.plan(apart, FACTORS), {}

    def merits(poses, kept, seconds, converged=np.nan):
        square = graphs.squared_residuals(apart._replace(poses=poses), FACTORS)
        chi2 = square["relative_pose"].sum() + np.asarray(square[LOOPS])[kept].sum()
        error = metrics.ate(truth[seen], np.asarray(poses)[seen])
        return {
            "position RMSE [m]": float(np.sqrt(np.mean(error.translation**2))),
            "greatest error [m]": float(np.max(error.translation)),
            "false loops kept": kept[false].mean() if false.any() else np.nan,
            "true loops kept": kept[true].mean(),
            "χ² of odometry and kept loops": float(chi2),
            "seconds": seconds,
            "converged": converged,
        }

    for name in ("none", *graphs.KERNELS):
        kernel = None if name == "none" else {LOOPS: graphs.KERNELS[name]()}
        options = {"kernel": kernel, "plan": plan, "iterations": 1000, "tolerance": 1e-9}
        graphs.optimize(apart, FACTORS, **options)
        began = time.process_time()
        solution = jax.block_until_ready(graphs.optimize(apart, FACTORS, **options))
        seconds = time.process_time() - began
        kept = np.ones(len(false), bool)
        if kernel:
            square = graphs.squared_residuals(solution.graph, FACTORS)[LOOPS]
            kept = np.asarray(kernel[LOOPS].weight(square)) > 0.5
        converged = float(solution.status == graphs.Ending.CONVERGED)
        found[name] = merits(solution.graph.poses, kept, seconds, converged)
    found["GTSAM's GNC"] = merits(*peer.graduated(apart))
    found["odometry"] = merits(graph.poses, np.zeros(len(false), bool), np.nan)
    return found


def true_poses(count: int):
    """The true pose of each of so many, (count, 3), and whether the true path has it."""
    rows = np.loadtxt(TRUTH, delimiter=",")
    at = np.linspace(rows[0, 0], rows[-1, 0], count)
    columns = [rows[:, 1], rows[:, 2], np.unwrap(rows[:, 3])]
    truth = np.stack([np.interp(at, rows[:, 0], column) for column in columns], axis=1)
    after = np.clip(np.searchsorted(rows[:, 0], at), 1, len(rows) - 1)
    return truth, rows[after, 0] - rows[after - 1, 0] < GAP
