"""Estimates of our own EKF as those of a stranger, in Python and in folders."""

import jax
import numpy as np

from jaxslam import run
from jaxslam.consistency import Innovations, RunEstimate
from jaxslam.core.types import Status
from jaxslam.results import report
from jaxslam.simulation._worlds import world_of_run

KEY = jax.random.key(5)


def as_a_stranger(world, ekf, traces=None):
    """The function of a log that runs an EKF and hands over NumPy arrays."""

    def estimate(log):
        trace = jax.device_get(run(ekf, log, world.pose, world.pose_cov, KEY))
        if traces is not None:
            traces.append(trace)
        of_map, info = trace.estimate, trace.info
        matched = (info.status == Status.FUSED) | (info.status == Status.REJECTED)
        row, place = np.nonzero(matched)
        likely = np.zeros(len(row))
        steps, first = np.unique(row, return_index=True)
        likely[first] = info.log_likelihood[steps]
        return RunEstimate(
            of_map.pose,
            of_map.pose_cov,
            (of_map.points, of_map.point_covs, np.where(of_map.alive, of_map.tag, -1)),
            Innovations(
                row,
                log.scan.tag[row, place],
                info.innovation[row, place],
                info.innovation_cov[row, place],
                info.status[row, place] == Status.REJECTED,
                info.nis[row, place],
                likely,
            ),
            of_map.further,
            of_map.further_cov,
        )

    return estimate


def write_estimates(folder, world, ekf, runs, key):
    """The estimates of an EKF, as `jaxslam run --innovations` writes them."""
    names = range(len(world.landmarks))
    for number in range(runs):
        _, log = world_of_run(world, key, number)
        trace = jax.device_get(run(ekf, log, world.pose, world.pose_cov, KEY))
        time, last = np.arange(1.0, world.steps + 1), jax.tree.map(lambda x: x[-1], trace.estimate)
        target = folder / f"{number:04d}"
        target.mkdir(parents=True)
        path = report.trajectory_csv(time, trace.estimate, world.motion.state[3:])
        (target / "trajectory.csv").write_text(path)
        (target / "map.csv").write_text(report.map_csv(last, names))
        text = report.innovations_csv(
            time, log.scan.tag, trace.info, names, world.sensor.measurements
        )
        (target / "innovations.csv").write_text(text)
    return folder
