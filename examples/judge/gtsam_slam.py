"""ISAM2 and the batch optimum of GTSAM, for the draws of a robot with velocities and a sensor of
relative positions at its pose, as those of the worlds `circle` and `loop`:

    pip install gtsam
    python gtsam_slam.py draws/runs/0000 isam2/0000
    python gtsam_slam.py --batch draws/runs/0000 batch/0000

ISAM2 gives each pose with its covariance as soon as the scan there is used, as a filter does. The
batch gives them after the last scan: the smoothed path. Both have the same factors, exactly the
model of the draws: the sensor measures R'(l - p), and the robot does not move sideways, which is a
constraint.
"""

import argparse
import csv
import itertools
import math
import tomllib
from pathlib import Path

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X


def motion_factor(k, travel, turn, noise):
    """The factor of poses k and k + 1: the robot moves ahead by travel, and then turns."""

    def error(factor, values, jacobians):
        before, after = values.atPose2(X(k)), values.atPose2(X(k + 1))
        step = before.between(after)
        ahead, left, turned = step.x(), step.y(), step.theta()
        if jacobians is not None:  # by the tangents of Pose2, which are in the frame of the pose
            c, s = math.cos(turned), math.sin(turned)
            jacobians[0] = np.array([[-1, 0, left], [0, -1, -ahead], [0, 0, -1]], float, order="F")
            jacobians[1] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]], order="F")
        return np.array([ahead - travel, left, math.remainder(turned - turn, 2 * math.pi)])

    return gtsam.CustomFactor(noise, [X(k), X(k + 1)], error)


def sensor_factor(k, tag, z, noise):
    """The factor of pose k and a landmark, of which z = R'(l - p) was measured."""

    def error(factor, values, jacobians):
        pose = values.atPose2(X(k))
        ahead, left = pose.transformTo(values.atPoint2(L(tag)))
        if jacobians is not None:
            c, s = math.cos(pose.theta()), math.sin(pose.theta())
            jacobians[0] = np.array([[-1, 0, left], [0, -1, -ahead]], float, order="F")
            jacobians[1] = np.array([[c, s], [-s, c]], order="F")
        return np.array([ahead - z[0], left - z[1]])

    return gtsam.CustomFactor(noise, [X(k), L(tag)], error)


def trajectory_row(t, pose, cov):
    """A line of trajectory.csv; cov is of the tangent of Pose2, in the frame of the pose."""
    c, s = math.cos(pose.theta()), math.sin(pose.theta())
    to_map = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    in_map = to_map @ cov @ to_map.T
    return [t, pose.x(), pose.y(), pose.theta(), *in_map[np.triu_indices(3)]]


def table(path, header):
    """The numbers of a CSV file with this header."""
    with path.open() as file:
        if file.readline().strip() != header:
            raise SystemExit(f"{path}: expected {header}")
        return np.loadtxt(file, delimiter=",", ndmin=2)


def write(path, header, rows):
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header.split(","), *rows])


def main(run, estimate, batch, threshold):
    odometry = table(run / "odometry.csv", "t [s],v [m/s],omega [rad/s]")
    measured = table(run / "measurements.csv", "t [s],tag,ahead [m],left [m]")
    settings = tomllib.loads((run / "dataset.toml").read_text())
    sigma_v, sigma_omega = settings["motion"]["noise"]
    sigmas = gtsam.noiseModel.Diagonal.Sigmas  # a σ of 0 is a constraint
    sensor_noise = sigmas(np.array(settings["sensor"]["noise"]))
    # Of a pose that is known exactly in one direction GTSAM's marginal covariance is zero in all:
    # a start that is known exactly is known to a micrometre here.
    start_noise = sigmas(np.maximum(settings["filter"]["start_noise"], 1e-6))

    parameters = gtsam.ISAM2Params()  # relinearizes every 10 updates what moved by more than 0.1
    if threshold is not None:
        parameters.relinearizeSkip = 1
        parameters.setRelinearizeThreshold(threshold)
    isam = gtsam.ISAM2(parameters)
    graph = gtsam.NonlinearFactorGraph()
    pose = gtsam.Pose2(*settings["filter"]["start"])
    factors, values = [gtsam.PriorFactorPose2(X(0), pose, start_noise)], gtsam.Values()
    values.insert(X(0), pose)
    trajectory, tags = [], set()
    for k, (before, now) in enumerate(itertools.pairwise(odometry)):
        t, dt = now[0], now[0] - before[0]
        travel, turn = before[1] * dt, before[2] * dt
        motion_noise = sigmas(np.array([sigma_v * dt, 0, sigma_omega * dt]))
        factors.append(motion_factor(k, travel, turn, motion_noise))
        pose = pose.compose(gtsam.Pose2(travel, 0, turn))
        values.insert(X(k + 1), pose)
        for tag, *z in measured[measured[:, 0] == t, 1:]:
            factors.append(sensor_factor(k + 1, int(tag), z, sensor_noise))
            if tag not in tags:
                values.insert(L(int(tag)), pose.transformFrom(np.array(z)))
                tags.add(tag)
        new = gtsam.NonlinearFactorGraph()
        for factor in factors:
            new.push_back(factor)
            graph.push_back(factor)
        isam.update(new, values)
        pose = isam.calculateEstimatePose2(X(k + 1))
        trajectory.append(trajectory_row(t, pose, isam.marginalCovariance(X(k + 1))))
        factors, values = [], gtsam.Values()
    optimum, marginals = isam.calculateBestEstimate(), isam
    if batch:
        # Not optimize(): the error may rise when a step repairs what the last one has broken of
        # the constraints, which are curved, and optimize() takes any rise for convergence.
        optimizer = gtsam.GaussNewtonOptimizer(graph, optimum, gtsam.GaussNewtonParams())
        for _ in range(30):
            optimizer.iterate()
            before, optimum = optimum, gtsam.Values(optimizer.values())  # iterate() frees its own
            step = before.localCoordinates(optimum).norm()
            if step < 1e-8:
                break
        else:
            raise SystemExit(f"{run}: the batch has not converged")
        marginals = gtsam.Marginals(graph, optimum)
        trajectory = [
            trajectory_row(t, optimum.atPose2(X(k)), marginals.marginalCovariance(X(k)))
            for k, t in enumerate(odometry[1:, 0], 1)
        ]
    landmarks = []
    for tag in sorted(map(int, tags)):
        cov = marginals.marginalCovariance(L(tag))
        landmarks.append([tag, *optimum.atPoint2(L(tag)), *cov[np.triu_indices(2)]])
    write(estimate / "trajectory.csv", "time,x,y,theta,c_xx,c_xy,c_xt,c_yy,c_yt,c_tt", trajectory)
    write(estimate / "map.csv", "landmark,x,y,c_xx,c_xy,c_yy", landmarks)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("estimate", type=Path)
    parser.add_argument("--batch", action="store_true", help="the optimum of the whole run")
    parser.add_argument(
        "--threshold", type=float, help="relinearize what moved by more, every time"
    )
    main(**vars(parser.parse_args()))
