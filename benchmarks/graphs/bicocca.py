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

import gtsam
import jax
import numpy as np

from benchmarks.graphs.worlds import with_false_closures
from benchmarks.real_data import DATA
from jaxslam import graphs, metrics
from jaxslam.math import se2, stats

GRAPH = DATA / "graphs" / "B25b_0.500.g2o"
TRUTH = DATA / "graphs" / "Bicocca_2009-02-25b-GT-extended.csv"
GAP = 1.0
"""[s]"""
NEAR = np.array([3.0, 3.0, 0.5])
"""what a loop may differ from the true path in [m, m, rad]"""
TRUSTED = "relative_pose"
FACTORS = {"relative_pose": graphs.RelativePoseLog()}


def compare(share: float) -> dict[str, dict[str, float]]:
    """Figures of merit by kernel, without one first, then GTSAM's, and the odometry last; a share
    of the loops is added and false."""
    graph = graphs.starts.odometry(graphs.with_gauge(graphs.read(GRAPH)))
    apart, loops, added = with_false_closures(graph, share)
    truth, seen = _true_poses(len(graph.poses))
    table = apart.tables[loops]
    first, second = truth[np.asarray(table.who).T]
    off = np.asarray(jax.jit(jax.vmap(se2.between))(first, second)) - np.asarray(table.z)
    off[:, 2] = np.angle(np.exp(1j * off[:, 2]))
    judged = ~added & seen[np.asarray(table.who)].all(axis=1)
    false = added | (judged & (np.abs(off) > NEAR).any(axis=1))
    true = judged & ~false
    print(
        f"\nBicocca 25b: {len(truth)} poses, {seen.sum()} with a true position, "
        f"{(~added).sum()} loops, {judged.sum()} of them judged, {(false & ~added).sum()} false; "
        f"{added.sum()} false ones added"
    )
    plan, found = graphs.plan(apart, FACTORS), {}

    def merits(poses, kept, chi2, seconds):
        error = metrics.ate(truth[seen], np.asarray(poses)[seen])
        return {
            "position RMSE [m]": float(np.sqrt(np.mean(error.translation**2))),
            "greatest error [m]": float(np.max(error.translation)),
            "false loops kept": kept[false].mean() if false.any() else np.nan,
            "true loops kept": kept[true].mean(),
            "χ² of odometry and kept loops": chi2,
            "seconds": seconds,
        }

    for name in ("none", *graphs.KERNELS):
        kernel = None if name == "none" else {loops: graphs.KERNELS[name]()}
        options = {"kernel": kernel, "plan": plan, "iterations": 1000, "tolerance": 1e-9}
        graphs.optimize(apart, FACTORS, **options)
        began = time.process_time()
        solution = jax.block_until_ready(graphs.optimize(apart, FACTORS, **options))
        seconds = time.process_time() - began
        square = {k: np.asarray(v) for k, v in _squares(solution.graph).items()}
        kept = np.ones(len(false), bool)
        if kernel:
            kept = np.asarray(kernel[loops].weight(square[loops])) > 0.5
        chi2 = square[TRUSTED].sum() + square[loops][kept].sum()
        found[name] = merits(solution.graph.poses, kept, chi2, seconds)
        found[name]["converged"] = float(solution.status == graphs.Ending.CONVERGED)
    poses, kept, seconds = _gtsam(apart, loops)
    square = _squares(apart._replace(poses=poses))
    chi2 = square[TRUSTED].sum() + np.asarray(square[loops])[kept].sum()
    found["GTSAM's GNC"] = {**merits(poses, kept, float(chi2), seconds), "converged": np.nan}
    found["odometry"] = {
        **merits(graph.poses, np.zeros(len(false), bool), 0.0, np.nan),
        "converged": np.nan,
    }
    return found


def _squares(graph):
    return graphs.squared_residuals(graph, FACTORS)


def _true_poses(count: int):
    """The true pose of each of so many, (count, 3), and whether the true path has it."""
    rows = np.loadtxt(TRUTH, delimiter=",")
    at = np.linspace(rows[0, 0], rows[-1, 0], count)
    columns = [rows[:, 1], rows[:, 2], np.unwrap(rows[:, 3])]
    truth = np.stack([np.interp(at, rows[:, 0], column) for column in columns], axis=1)
    after = np.clip(np.searchsorted(rows[:, 0], at), 1, len(rows) - 1)
    return truth, rows[after, 0] - rows[after - 1, 0] < GAP


def _gtsam(apart, loops):
    """Poses, which loops are kept, and processor seconds of GTSAM's graduated non-convexity."""
    factors, start, trusted = gtsam.NonlinearFactorGraph(), gtsam.Values(), 0
    for name in (TRUSTED, loops):
        table = apart.tables[name]
        for (i, j), z, information in zip(table.who, table.z, table.information, strict=True):
            noise = gtsam.noiseModel.Gaussian.Information(np.asarray(information))
            factors.add(gtsam.BetweenFactorPose2(int(i), int(j), gtsam.Pose2(*z), noise))
        trusted = trusted or factors.size()
    for k, pose in enumerate(apart.poses):
        start.insert(k, gtsam.Pose2(*pose))
    held = gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)
    factors.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*apart.poses[0]), held))
    parameters = gtsam.GncLMParams()
    parameters.setLossType(gtsam.GncLossType.TLS)
    parameters.setKnownInliers([*range(trusted), factors.size() - 1])
    solver = gtsam.GncLMOptimizer(factors, start, parameters)
    solver.setInlierCostThresholds(0.5 * float(stats.chi2_quantile(0.99, 3)))
    began = time.process_time()
    found = solver.optimize()
    seconds = time.process_time() - began
    poses = [found.atPose2(k) for k in range(len(apart.poses))]
    poses = np.array([[pose.x(), pose.y(), pose.theta()] for pose in poses])
    return poses, np.asarray(solver.getWeights())[trusted:-1] > 0.5, seconds
