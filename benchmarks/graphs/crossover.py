"""When is a graph cheaper than a filter? By the numbers of poses p and of landmarks n.

A robot drives once round a circle inside n landmarks, and measures eight in each of p poses.
EKF-SLAM estimates the last pose and the map, in p updates of O(n²) each. `graphs.optimize`
estimates all poses and the map from a start along the odometry, in some factorizations of a sparse
matrix, whose plan (elimination order and pattern) is timed apart. Both in processor seconds, the
fastest of some calls, after compilation. The crossing is the n at which both cost the same, by
interpolation of the logarithms.
"""

import time
from functools import partial

import jax
import numpy as np

import jaxslam
from benchmarks.gate import Metric, table
from jaxslam import graphs
from jaxslam.core.types import Log, Scan

POSES, LANDMARKS, SEEN = (32, 128, 512), (16, 32, 64, 128, 256), 8
KEY = jax.random.key(0)
MOTION = jaxslam.motion.PoseIncrement(np.diag([0.02, 0.02, 0.005]) ** 2)
SENSOR = jaxslam.sensors.RelativePosition(0.1**2 * np.eye(2))


def drive(poses: int, landmarks: int) -> Log:
    """The log of one round."""
    random, turn = np.random.default_rng(0), 2 * np.pi / poses
    heading = turn * np.arange(1, poses + 1)
    at = 10 * np.column_stack([np.sin(heading), 1 - np.cos(heading)])
    around = 2 * np.pi * np.arange(landmarks) / landmarks
    points = np.column_stack([13 * np.sin(around), 10 - 13 * np.cos(around)])
    first = np.floor(heading / (2 * np.pi) * landmarks).astype(int)
    tag = (first[:, None] + np.arange(SEEN)) % landmarks
    away = points[tag] - at[:, None]
    c, s = np.cos(heading)[:, None], np.sin(heading)[:, None]
    z = np.stack([c * away[..., 0] + s * away[..., 1], c * away[..., 1] - s * away[..., 0]], -1)
    chord = 20 * np.sin(turn / 2)
    step = [chord * np.cos(turn / 2), chord * np.sin(turn / 2), turn]
    odometry = step + random.normal(size=(poses, 3)) * [0.02, 0.02, 0.005]
    scan = Scan(z + 0.1 * random.normal(size=z.shape), tag, np.ones(tag.shape, bool))
    return Log(odometry, scan)


def seconds(work, repeats: int) -> float:
    """Processor seconds of the fastest of some calls; the first compiles."""
    jax.block_until_ready(work())
    times = []
    for _ in range(repeats):
        began = time.process_time()
        jax.block_until_ready(work())
        times.append(time.process_time() - began)
    return min(times)


def measure(quick: bool = False) -> list[Metric]:
    repeats, start = 3 if quick else 15, (np.zeros(3), np.zeros((3, 3)))
    rows, metrics = [], []
    for p in POSES[: 1 if quick else None]:
        ratio = []
        for n in LANDMARKS:
            log = jax.device_put(drive(p, n))
            ekf = jaxslam.filters.EkfSlam(MOTION, SENSOR, n, correction="joint")
            follow = jax.jit(lambda log, ekf=ekf: jaxslam.run(ekf, log, *start, KEY).final)
            graph, factors = graphs.of_log(log, MOTION, SENSOR, *start)
            began = time.process_time()
            plan = graphs.plan(graph, factors)
            planned = time.process_time() - began
            solve = partial(graphs.optimize, graph, factors, plan=plan)
            filtered, solved = seconds(partial(follow, log), repeats), seconds(solve, repeats)
            ratio.append(solved / filtered)
            cells = f"{1e3 * filtered:.2f}", f"{1e3 * solved:.2f}", f"{ratio[-1]:.2f}"
            rows.append((str(p), str(n), *cells, str(solve().iterations), f"{planned:.2f}"))
        cross = np.exp(np.interp(0.0, -np.log(ratio), np.log(LANDMARKS)))
        metrics += [
            Metric(f"graph / filter, {p} poses, {LANDMARKS[0]} landmarks", ratio[0], low=1.0),
            Metric(f"graph / filter, {p} poses, {LANDMARKS[-1]} landmarks", ratio[-1], high=1.0),
            Metric(f"landmarks at which both cost the same, {p} poses", float(cross)),
        ]
    head = "poses p", "landmarks n", "filter [ms]", "graph [ms]", "graph / filter", "steps"
    print(table((*head, "plan [s]"), rows))
    return metrics
