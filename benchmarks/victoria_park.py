"""Victoria Park: EKF-SLAM against GTSAM's batch solution of the same log.

    python -m benchmarks.victoria_park [PATH] [--out figure.png] [--from odometry|ekf]

The batch problem has the EKF's models and noise: between factors for the odometry, and for each
sighting the residual R(θ)ᵀ(l - t) - z with GTSAM's own Jacobians, minimised by Levenberg-Marquardt.
The two maps are brought together by the SE(2) motion that fits their landmarks best, which also
moves the EKF's path. The path of the EKF is what it believed at each step, the batch's is smoothed.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import gtsam
import jax
import jax.numpy as jnp
import numpy as np
from gtsam.symbol_shorthand import L, X
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from numpy.typing import NDArray

import jaxslam
from jaxslam import datasets, se2
from jaxslam.datasets import Dataset
from jaxslam.filters import ekf_slam
from jaxslam.types import Estimate

Array = NDArray[np.float64]


class Solution(NamedTuple):
    """A path (T, 3) and a map (N, 2) in the frame of the robot's start, tags in order."""

    path: Array
    points: Array


class Batch(NamedTuple):
    """What GTSAM found: half the sum of squares before and after, and how long it took."""

    solution: Solution
    error_before: float
    error_after: float
    iterations: int
    seconds: float


def run_ekf(data: Dataset) -> tuple[Solution, Array, dict[str, float]]:
    """The EKF's path and map, the landmark covariances (N, 2, 2), and its figures."""
    ekf = ekf_slam(data.motion, data.sensor, data.capacity, **data.filter_options)

    @jax.jit
    def go(log: Any) -> tuple[jax.Array, Estimate, jax.Array, jax.Array]:
        trace = jaxslam.run(ekf, log, data.pose, data.pose_cov, jax.random.key(0))
        info = trace.info
        return trace.estimate.pose, ekf.estimate(trace.final), info.nis.sum(), info.dof.sum()

    begin = time.perf_counter()
    jax.block_until_ready(go(data.log))
    compiled = time.perf_counter()
    path, final, nis, dof = jax.block_until_ready(go(data.log))
    figures = {
        "compile_and_run_s": compiled - begin,
        "run_s": time.perf_counter() - compiled,
        "nis_per_dof": float(nis / dof),
    }
    if not np.asarray(final.alive).all():
        raise ValueError("the EKF's map lacks landmarks")
    order = np.argsort(np.asarray(final.tag))
    solution = Solution(np.asarray(path), np.asarray(final.points)[order])
    return solution, np.asarray(final.point_covs)[order], figures


def dead_reckoning(data: Dataset) -> Solution:
    """The path of the odometry alone, and each landmark where its first sighting puts it."""

    def step(pose: jax.Array, u: jax.Array) -> tuple[jax.Array, jax.Array]:
        pose = data.motion.step(pose, u, jnp.zeros(len(data.motion.noises)))
        return pose, pose

    _, path = jax.lax.scan(step, jnp.asarray(data.pose), jnp.asarray(data.log.control))
    points = np.zeros((data.capacity, 2))
    row, place = np.nonzero(data.log.scan.valid)
    tag = np.asarray(data.log.scan.tag)[row, place]
    first = np.unique(tag, return_index=True)[1]
    seen_from, z = path[row[first]], jnp.asarray(data.log.scan.z)[row[first], place[first]]
    points[tag[first]] = jax.vmap(data.sensor.invert)(seen_from, z, jnp.zeros((first.size, 0)))
    return Solution(np.asarray(path), points)


def run_batch(data: Dataset, start: Solution) -> Batch:
    """Levenberg-Marquardt over all poses and landmarks; X(0) is the start, X(t + 1) row t."""
    begin = time.perf_counter()
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.NonlinearEqualityPose2(X(0), gtsam.Pose2(*data.pose)))
    values.insert(X(0), gtsam.Pose2(*data.pose))
    control, (z, tag, valid) = data.log.control, data.log.scan
    poses = jnp.zeros((data.steps, 3))
    odometry_covs = np.asarray(jax.vmap(data.motion.noise_cov)(poses, jnp.asarray(control)))
    for t in range(data.steps):
        noise = gtsam.noiseModel.Gaussian.Covariance(odometry_covs[t])
        graph.add(gtsam.BetweenFactorPose2(X(t), X(t + 1), gtsam.Pose2(*control[t]), noise))
        values.insert(X(t + 1), gtsam.Pose2(*start.path[t]))
    for i, point in enumerate(start.points):
        values.insert(L(i), point)
    rows, places = np.nonzero(valid)
    seen = jnp.asarray(z)[rows, places]
    covs = np.asarray(jax.vmap(data.sensor.noise_cov)(seen))
    for t, m, cov in zip(rows, places, covs, strict=True):
        noise = gtsam.noiseModel.Gaussian.Covariance(cov)
        keys = [X(int(t) + 1), L(int(tag[t, m]))]
        graph.add(gtsam.CustomFactor(noise, keys, position_error(np.asarray(z[t, m]))))
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values)
    result = optimizer.optimize()
    poses_found = [result.atPose2(X(t + 1)) for t in range(data.steps)]
    found = Solution(
        np.array([[p.x(), p.y(), p.theta()] for p in poses_found]),
        np.array([result.atPoint2(L(i)) for i in range(data.capacity)]),
    )
    return Batch(
        solution=found,
        error_before=graph.error(values),
        error_after=graph.error(result),
        iterations=optimizer.iterations(),
        seconds=time.perf_counter() - begin,
    )


def position_error(z: Array) -> Callable[[Any, Any, Any], Array]:
    """R(θ)ᵀ(l - t) - z and its Jacobians, in the form GTSAM's CustomFactor calls."""

    def error(this: Any, values: Any, jacobians: Any) -> Array:
        pose, point = values.atPose2(this.keys()[0]), values.atPoint2(this.keys()[1])
        by_pose, by_point = np.zeros((2, 3), order="F"), np.zeros((2, 2), order="F")
        predicted = pose.transformTo(point, by_pose, by_point)
        if jacobians is not None:
            jacobians[0], jacobians[1] = by_pose, by_point
        return np.asarray(predicted - z)

    return error


def compare(ekf: Solution, batch: Solution) -> tuple[Solution, dict[str, float]]:
    """The EKF's solution moved onto the batch's, and how far apart they are [m]."""
    move = se2.align(jnp.asarray(ekf.points), jnp.asarray(batch.points))
    onto = jax.vmap(se2.from_frame, in_axes=(None, 0))
    points = np.asarray(onto(move, jnp.asarray(ekf.points)))
    path = np.asarray(jax.vmap(se2.compose, in_axes=(None, 0))(move, jnp.asarray(ekf.path)))
    apart = np.linalg.norm(points - batch.points, axis=1)
    path_apart = np.linalg.norm(path[:, :2] - batch.path[:, :2], axis=1)
    return Solution(path, points), {
        "landmark_rmse_m": float(np.sqrt(np.mean(apart**2))),
        "landmark_max_m": float(apart.max()),
        "path_rmse_m": float(np.sqrt(np.mean(path_apart**2))),
        "path_max_m": float(path_apart.max()),
        "turned_deg": float(np.rad2deg(move[2])),
        "moved_m": float(np.linalg.norm(move[:2])),
    }


def draw(ekf: Solution, covs: Array, batch: Solution, out: str) -> None:
    """Both paths and both maps with the EKF's 3σ ellipses, in the frame of the start."""
    figure = Figure(figsize=(7.0, 6.4), layout="constrained")
    axes = figure.subplots()
    axes.plot(*batch.path[:, :2].T, color="0.55", lw=1.6, label="path, batch (GTSAM)")
    axes.plot(*ekf.path[:, :2].T, color="tab:blue", lw=0.7, label="path, EKF")
    axes.plot(*batch.points.T, "x", color="0.25", ms=4, mew=0.9, label="landmarks, batch (GTSAM)")
    axes.plot(*ekf.points.T, ".", color="tab:red", ms=3, label="landmarks, EKF")
    for point, cov in zip(ekf.points, covs, strict=True):
        variance, direction = np.linalg.eigh(cov)
        axes.add_patch(
            Ellipse(
                (point[0], point[1]),
                *(6 * np.sqrt(variance)),
                angle=np.rad2deg(np.arctan2(direction[1, 0], direction[0, 0])),
                fill=False,
                color="tab:red",
                lw=0.6,
                label="3σ of the EKF" if point is ekf.points[0] else None,
            )
        )
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.legend(fontsize=8)
    figure.savefig(out, dpi=200)


def main() -> None:
    """Run, print and draw."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.victoria_park")
    parser.add_argument("path", nargs="?", help="default: the file that comes with GTSAM")
    parser.add_argument("--out", help="write the figure to this PNG")
    parser.add_argument("--from", dest="start", choices=("odometry", "ekf"), default="odometry")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)

    begin = time.perf_counter()
    path = arguments.path or gtsam.findExampleDataFile("victoria_park.txt")
    data = datasets.victoria_park(path)
    print(
        f"log: {data.steps} poses, {data.measurements} measurements, {data.capacity} landmarks, "
        f"read in {time.perf_counter() - begin:.2f} s"
    )
    ekf, covs, figures = run_ekf(data)
    print(
        f"EKF: {figures['run_s']:.2f} s ({figures['compile_and_run_s']:.2f} s with compilation), "
        f"NIS/dof {figures['nis_per_dof']:.3f}"
    )
    batch = run_batch(data, dead_reckoning(data) if arguments.start == "odometry" else ekf)
    print(
        f"batch (GTSAM, from {arguments.start}): error {batch.error_before:.1f} -> "
        f"{batch.error_after:.3f} in {batch.iterations} iterations, {batch.seconds:.2f} s"
    )
    _, apart = compare(ekf, batch.solution)
    print(
        f"EKF against batch after SE(2) alignment on {data.capacity} landmarks, {data.steps} poses:"
    )
    for name, value in apart.items():
        print(f"  {name:16} {value:.3f}")
    if arguments.out:
        draw(ekf, covs, batch.solution, arguments.out)
        print(f"figure: {arguments.out}")


if __name__ == "__main__":
    main()
