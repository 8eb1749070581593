"""GTSAM on the same graphs."""

import time

import gtsam
import numpy as np

from jaxslam.graphs._graph import LOOPS
from jaxslam.math import stats

HELD = gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)


def problem(graph, tables=("relative_pose",), held=HELD):
    """Factors and start of a graph of relative poses, one pose of which is held."""
    factors, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for name in tables:
        table = graph.tables[name]
        for (i, j), z, information in zip(table.who, table.z, table.information, strict=True):
            noise = gtsam.noiseModel.Gaussian.Information(np.asarray(information))
            factors.add(gtsam.BetweenFactorPose2(int(i), int(j), gtsam.Pose2(*z), noise))
    for k, pose in enumerate(np.asarray(graph.poses)):
        start.insert(k, gtsam.Pose2(*pose))
    fixed = int(np.asarray(graph.fixed_pose).argmax())
    factors.add(gtsam.PriorFactorPose2(fixed, gtsam.Pose2(*graph.poses[fixed]), held))
    return factors, start


def graduated(apart):
    """Poses, the loops that are kept, and processor seconds of graduated non-convexity, from the
    poses of a graph with its loops apart; it trusts the odometry, and has our threshold."""
    factors, start = problem(apart, ("relative_pose", LOOPS))
    trusted = len(apart.tables["relative_pose"].z)
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
