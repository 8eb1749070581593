"""Estimates of our own EKF as those of a stranger, and folders of draws and estimates."""

import json

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
        )

    return estimate


def write_draws(folder, world, scenario, runs, key, steps):
    """A folder of draws without logs: what `jaxslam judge` reads of it."""
    numbers = np.asarray(jax.random.key_data(key)).tolist()
    record = {
        "scenario": world.name,
        "runs": runs,
        "key": {"kind": str(jax.random.key_impl(key)), "numbers": numbers},
        "options": {"scenario": scenario, "steps": steps},
    }
    folder.mkdir()
    (folder / "draws.json").write_text(json.dumps(record))
    for number in range(runs):
        truth, log = jax.device_get(world_of_run(world, key, number))
        run_folder, true_folder = (folder / kind / f"{number:04d}" for kind in ("runs", "truth"))
        run_folder.mkdir(parents=True)
        true_folder.mkdir(parents=True)
        time = range(world.steps + 1)
        (run_folder / "odometry.csv").write_text("t [s]\n" + "".join(f"{t}\n" for t in time))
        scan, names = log.scan, ",".join(world.sensor.measurements)
        rows = [
            f"{t + 1},{scan.tag[t, m]},{','.join(map('{:.17g}'.format, scan.z[t, m]))}\n"
            for t, m in np.argwhere(scan.valid)
        ]
        (run_folder / "measurements.csv").write_text(f"t [s],tag,{names}\n" + "".join(rows))
        rows = [
            f"{t + 1},{','.join(map('{:.17g}'.format, pose))}\n"
            for t, pose in enumerate(truth.pose)
        ]
        (true_folder / "truth.csv").write_text("t [s],x [m],y [m],theta [rad]\n" + "".join(rows))
        rows = [f"{i},{x:.17g},{y:.17g}\n" for i, (x, y) in enumerate(truth.landmarks)]
        (true_folder / "landmarks.csv").write_text("tag,x [m],y [m]\n" + "".join(rows))
    return folder


def write_estimates(folder, world, ekf, runs, key):
    """The estimates of an EKF, as `jaxslam run --innovations` writes them."""
    names = range(len(world.landmarks))
    for number in range(runs):
        _, log = world_of_run(world, key, number)
        trace = jax.device_get(run(ekf, log, world.pose, world.pose_cov, KEY))
        time, last = np.arange(1.0, world.steps + 1), jax.tree.map(lambda x: x[-1], trace.estimate)
        target = folder / f"{number:04d}"
        target.mkdir(parents=True)
        (target / "trajectory.csv").write_text(report.trajectory_csv(time, trace.estimate))
        (target / "map.csv").write_text(report.map_csv(last, names))
        text = report.innovations_csv(
            time, log.scan.tag, trace.info, names, world.sensor.measurements
        )
        (target / "innovations.csv").write_text(text)
    return folder
