"""Bicocca 25b, whose loop closures by appearance are partly false: robust kernels beside GTSAM's.

The odometry is that of `B25b_0.500.g2o`; the true path, in the CSV, has times, the graph none. Its
poses are taken as evenly spaced over the time of the true path: with this the turns of the odometry
are those of the true path, 0.09 rad in ten steps, and with a step 1 % longer or shorter they are
not. A loop is true where the true path has it to within 3 m and 0.5 rad, judged where the true path
has no gap of a second. All start at the odometry, and trust it; positions are compared after
alignment. GTSAM's graduated non-convexity has the same threshold, the 99 % quantile of χ² with
three degrees of freedom, and its own Levenberg-Marquardt.
"""

import time

import gtsam
import jax
import numpy as np

from benchmarks.real_data import DATA
from jaxslam import graphs, metrics
from jaxslam.graphs.loops import LOOPS
from jaxslam.math import se2, stats

GRAPH = DATA / "graphs" / "B25b_0.500.g2o"
TRUTH = DATA / "graphs" / "Bicocca_2009-02-25b-GT-extended.csv"
GAP = 1.0
"""[s]"""
NEAR = np.array([3.0, 3.0, 0.5])
"""what a loop may differ from the true path in [m, m, rad]"""
FACTORS = {"relative_pose": graphs.relative_pose_log()}


def compare() -> dict[str, dict[str, float]]:
    """Figures of merit by kernel, without one first and GTSAM's last."""
    graph = graphs.starts.odometry(graphs.with_gauge(graphs.read(GRAPH)))
    apart = graphs.with_loops_apart(graph)
    truth, seen = _true_poses(len(graph.poses))
    loops = np.asarray(apart.tables[LOOPS].who)
    between = np.asarray(jax.vmap(se2.between)(truth[loops[:, 0]], truth[loops[:, 1]]))
    off = between - np.asarray(apart.tables[LOOPS].z)
    off[:, 2] = np.angle(np.exp(1j * off[:, 2]))
    judged = seen[loops].all(axis=1)
    true = (np.abs(off) < NEAR).all(axis=1)
    print(
        f"Bicocca 25b: {len(truth)} poses, {len(loops)} loops, {judged.sum()} of them judged, "
        f"{(judged & ~true).sum()} false; {seen.sum()} poses with a true position"
    )
    plan, found = graphs.plan(apart, FACTORS), {}

    def merits(poses, kept, chi2, seconds):
        error = metrics.ate(truth[seen], np.asarray(poses)[seen])
        return {
            "position RMSE [m]": float(np.sqrt(np.mean(error.translation**2))),
            "greatest position error [m]": float(np.max(error.translation)),
            "false loops kept": kept[judged & ~true].mean(),
            "true loops kept": kept[judged & true].mean(),
            "χ² of the kept and the odometry": chi2,
            "seconds": seconds,
        }

    for name in ("none", *graphs.KERNELS):
        kernel = None if name == "none" else {LOOPS: graphs.KERNELS[name]()}
        options = {"kernel": kernel, "plan": plan, "iterations": 1000, "tolerance": 1e-9}
        graphs.optimize(apart, FACTORS, **options)
        began = time.process_time()
        solution = jax.block_until_ready(graphs.optimize(apart, FACTORS, **options))
        seconds = time.process_time() - began
        square = {k: np.asarray(v) for k, v in _squares(solution.graph).items()}
        kept = np.ones(len(loops), bool)
        if kernel:
            kept = np.asarray(kernel[LOOPS].weight(square[LOOPS])) > 0.5
        chi2 = square["relative_pose"].sum() + square[LOOPS][kept].sum()
        found[name] = merits(solution.graph.poses, kept, chi2, seconds)
        found[name]["converged"] = float(solution.status == graphs.Ending.CONVERGED)
    poses, kept, seconds = _gtsam(apart)
    square = _squares(apart._replace(poses=poses))
    chi2 = square["relative_pose"].sum() + np.asarray(square[LOOPS])[kept].sum()
    found["GTSAM's GNC"] = {**merits(poses, kept, float(chi2), seconds), "converged": np.nan}
    found["odometry"] = {
        **merits(graph.poses, np.zeros(len(loops), bool), 0.0, np.nan),
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


def _gtsam(apart):
    """Poses, which loops are kept, and processor seconds of GTSAM's graduated non-convexity."""
    factors, start, trusted = gtsam.NonlinearFactorGraph(), gtsam.Values(), 0
    for name in ("relative_pose", LOOPS):
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
