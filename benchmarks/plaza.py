"""Range-only SLAM on recorded data, beacons unknown.

Plaza1 (Djugash, Hamner & Roth 2009, as with GTSAM): a lawn mower drives 1.9 km in half an hour and
measures its distance from four radio beacons, one at a time. `DelayedSlam` gets odometry and
ranges alone; which beacon a range is of is known, where the beacons stand is not. Scored after the
SE(2) motion that fits the path best onto the ground truth; the same motion carries the beacons.

What is taken from the ground truth: the bias of the ranges (the reader's RANGE_BIAS, 3 cm + 6.9 %,
one line for all beacons) and that they are then good to 0.5 m, as of a calibration beforehand; the
row without it shows what that is worth. The heading increments of the file's odometry *are* those
of its ground truth, so dead reckoning is good already, and stands beside it. Gross errors are rare
in this file; the last row replaces one range in ten by anything from 0 to 80 m.
"""

import gtsam
import jax
import jax.numpy as jnp
import numpy as np

import jaxslam
from benchmarks.gate import Metric, save, show
from jaxslam import datasets, metrics
from jaxslam.consistency.metrics._paths import transform
from jaxslam.core.types import Status
from jaxslam.filters import DelayedSlam, StoredMeasurements
from jaxslam.results.plot import COLORS, FAINT, INK, PAGE, SHADE, caption, panels_of

STORED = StoredMeasurements(capacity=40, spacing=2.0)
SPOILED, FARTHEST = 0.1, 80.0


def read(**options):
    return datasets.plaza(gtsam.findExampleDataFile("Plaza1_.mat"), **options)


def spoil(log):
    """One range in ten replaced by a uniform draw."""
    rng = np.random.default_rng(0)
    bad = rng.uniform(size=log.scan.z.shape) < SPOILED
    z = np.where(bad, rng.uniform(0.0, FARTHEST, log.scan.z.shape), log.scan.z)
    return log._replace(scan=log.scan._replace(z=z))


def dead_reckoning(data):
    def step(pose, u):
        pose = data.motion.step(pose, u, jnp.zeros(len(data.motion.noises)))
        return pose, pose

    return jax.lax.scan(step, jnp.asarray(data.pose), jnp.asarray(data.log.control))[1]


def aligned(path, data):
    """The motion onto the ground truth, the path there (T, 2), and its RMSE [m]."""
    motion = metrics.alignment(path[:, :2], data.true_path[:, :2])
    path = transform(motion, path[:, :2])
    off = np.linalg.norm(path - data.true_path[:, :2], axis=1)
    return motion, path, metrics.statistics(off).rmse


def beacons(motion, estimate, data):
    """Where the beacons of the map are in the survey's frame (K, 2), and their errors, by tag."""
    alive = np.asarray(estimate.alive)
    points = transform(motion, estimate.points[alive])
    tags = np.asarray(estimate.tag)[alive]
    return points, np.linalg.norm(points - data.landmarks[tags], axis=1)[np.argsort(tags)]


def measure(quick: bool = False) -> list[Metric]:
    data, raw = read(), read(range_bias=(0.0, 0.0))
    slam = DelayedSlam(data.motion, data.sensor, data.capacity, stored=STORED)

    @jax.jit
    def go(log):
        return jaxslam.run(slam, log, data.pose, data.pose_cov, jax.random.key(0))

    logs = {
        "delayed_slam": data.log,
        "ranges as they are": raw.log,
        "10 % spoiled": spoil(data.log),
    }
    _, reckoned, rmse = aligned(dead_reckoning(data), data)
    rows = {"odometry alone": {"path RMSE [m]": f"{rmse:.2f}"}}
    found = []
    for name, log in logs.items():
        trace = go(log)
        motion, path, rmse = aligned(trace.estimate.pose, data)
        points, off = beacons(motion, jax.tree.map(lambda x: x[-1], trace.estimate), data)
        rows[name] = {
            "path RMSE [m]": f"{rmse:.2f}",
            "beacons found": len(off),
            "errors [m]": " ".join(f"{e:.2f}" for e in off),
            "rejected": int(trace.info.tally(Status.REJECTED).sum()),
        }
        if log is not raw.log:
            worst = off.max() if len(off) == data.capacity else np.inf
            found.append(Metric(f"Plaza1, {name}: path RMSE [m]", rmse, high=1.5))
            found.append(Metric(f"Plaza1, {name}: worst beacon [m]", worst, high=1.0))
        if log is data.log and not quick:
            save(figure(data, path, reckoned, points), "plaza1")
    show(f"Plaza1: {data.steps:,} rows, {data.measurements:,} ranges", rows)
    return found


def figure(data, path, reckoned, points):
    figure, (axes,) = panels_of(PAGE, 6.0, 1)
    blue, red, *_ = COLORS
    axes.plot(*data.true_path[:, :2].T, color=SHADE, lw=2.5, label="ground truth")
    axes.plot(*reckoned.T, color=FAINT, lw=0.6, ls="--", label="odometry alone, aligned")
    axes.plot(*path.T, color=blue, lw=0.9, label="delayed_slam, aligned")
    axes.plot(*data.landmarks.T, "^", color=INK, ms=9, mfc="none", label="beacons, surveyed")
    axes.plot(*points.T, "x", color=red, ms=7, mew=1.5, label="beacons, estimated")
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.margins(0.06)
    caption(figure, "Plaza1: SLAM by ranges alone, beacons unknown")
    return figure
