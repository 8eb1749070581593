"""Is the covariance of laser odometry honest? Runs through a simulated office."""

import dataclasses

import jax
import numpy as np

from benchmarks.gate import Metric, show
from jaxslam import Campaign, filters, laser_slam, monte_carlo, recorded_world, scenarios, sensors
from jaxslam.consistency import pose_error
from jaxslam.core.types import Log, Scan
from jaxslam.laser.laser_slam import ScanLog, Settings
from jaxslam.laser.laser_slam import _end_covariances as end_covariances
from jaxslam.laser.laser_slam._odometry import raw
from jaxslam.laser.laser_slam._odometry.log_odometry import laser_odometry
from jaxslam.laser.laser_slam._scan_points import scans_of
from jaxslam.math import numpy_poses as poses
from jaxslam.simulation.laser import scan_world

EVERY = 4
"""Scans of the world of which one is used: half a metre, or 45°."""
SETTINGS = Settings(beams=90, max_range=8.0, key_distance=0.3, loop_gap=15, submap_every=2)


def logs(runs: int):
    """Pairs (true poses, log)."""
    world = scenarios.office(beams=90)
    for seed in range(runs):
        history = jax.tree.map(np.asarray, scan_world(world, jax.random.key(seed)))
        speed, turn, interval = history.control.T
        zero = np.zeros_like(speed)
        steps = np.stack([speed * interval, zero, turn * interval], axis=1)
        # The step of a unicycle: along an arc, whose chord is turned by half of the turn.
        half = 0.5 * steps[:, 2]
        length = steps[:, 0] * np.sinc(half / np.pi)
        steps[:, 0], steps[:, 1] = length * np.cos(half), length * np.sin(half)
        raw = poses.chain(np.asarray(world.pose, float), steps)[1:]
        kept = np.arange(0, len(raw), EVERY)
        beams_of = jax.tree.map(lambda part: part[kept], history.beams)
        time = np.cumsum(interval)[kept]
        # The robot is where the first scan is: all paths start there.
        true = history.pose[kept]
        start = poses.compose(true[0], poses.inverse(raw[kept][0]))
        yield true, ScanLog(time, beams_of, poses.compose(start, raw[kept]), 8.0)


def campaign(records: list[tuple[np.ndarray, np.ndarray]]) -> Campaign:
    """An EKF that is driven by laser odometry, judged over runs (controls, true poses).

    A row a keyframe; of all runs those that the shortest has. Poses are relative to the first.
    """
    motion, sensor = laser_slam.MatchMotion(), sensors.RangeBearing(np.eye(2))
    rows = min(len(control) for control, _ in records)
    nothing = Scan(np.zeros((rows, 1, 2)), np.full((rows, 1), -1), np.zeros((rows, 1), bool))
    world = recorded_world(
        motion,
        sensor,
        [Log(control[:rows], nothing) for control, _ in records],
        [poses.between(true[:1], true[:rows]) for _, true in records],
        landmarks=np.zeros((1, 2)),  # none is seen
        name="office, laser odometry",
    )
    ekf = {"ekf": filters.DeadReckoning(motion, sensor)}
    return monte_carlo(world, ekf, len(records), jax.random.key(0), progress=False)


def nees(error: np.ndarray, cov: np.ndarray) -> np.ndarray:
    return np.einsum("ki,kij,kj->k", error, np.linalg.inv(cov), error)


def rmse_of(path: np.ndarray, true: np.ndarray) -> float:
    return float(np.sqrt(((path - true)[:, :2] ** 2).sum(axis=1).mean()))


def steps_of(odometry, true):
    """NEES of each match relative to its keyframe."""
    rows = np.flatnonzero(odometry.matched)
    z = poses.between(true[odometry.base[rows]], true[rows])
    return nees(poses.between(odometry.z[rows], z), odometry.cov[rows])


def path_of(odometry, true):
    """NEES of the keyframes by the chain of matches."""
    keys = odometry.keyframe
    total = end_covariances.along(odometry.poses[keys], odometry.cov[keys[1:]])
    zero = np.zeros(len(keys) - 1, int)
    cov = end_covariances.relative_cov(total, odometry.poses[keys], zero, np.arange(1, len(keys)))
    return nees(poses.between(odometry.poses[keys[1:]], true[keys[1:]]), cov)


def measure(runs: int) -> list[Metric]:
    found: dict[str, list[np.ndarray]] = {}
    records: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    chi2, closures, position = [], [], {}
    for true, log in logs(runs):
        for name, reference in (("scan to scan", 1), ("scan to submap", SETTINGS.reference)):
            settings = dataclasses.replace(SETTINGS, reference=reference)
            scans = scans_of(log, settings)
            steps = raw.steps_of(log.raw, settings)
            odometry = laser_odometry(scans, steps, settings, log.raw[0])
            found.setdefault(f"{name}: a match", []).append(steps_of(odometry, true))
            found.setdefault(f"{name}: the path", []).append(path_of(odometry, true))
            pair = laser_slam.match_controls(odometry), true[odometry.keyframe]
            records.setdefault(name, []).append(pair)
            position.setdefault(name, []).append(rmse_of(odometry.poses, true))
        solved = laser_slam.solve(log, SETTINGS)
        # The marginals are of coordinates; the first pose is certain.
        keys = solved.keyframe[1:]
        error = pose_error(solved.poses[keys], true[keys])
        found.setdefault("graph with loops: the path", []).append(nees(error, solved.cov[keys]))
        position.setdefault("graph with loops", []).append(rmse_of(solved.poses, true))
        chi2.append(solved.chi2 / max(solved.dof, 1))
        closures.append(laser_slam.closure_score(solved, true, gap=SETTINGS.loop_gap))
    metrics, rows = [], {}
    for name, runs_of in found.items():
        means = np.array([each.mean() for each in runs_of])
        half = 1.96 * means.std(ddof=1) / np.sqrt(len(means)) if len(means) > 1 else np.nan
        rmse = "" if name.endswith("match") else f"{np.mean(position[name.split(':')[0]]):.3f}"
        rows[name] = {
            "mean of runs": f"{means.mean():.2f} ± {half:.2f}",
            "median of all": f"{np.median(np.concatenate(runs_of)):.2f}",
            "RMSE of position [m]": rmse,
        }
        metrics.append(Metric(f"office, NEES, {name}", means.mean(), note="3 is honest"))
    show("office, NEES (3 is honest)", rows)
    for name, of in records.items():
        ekf = campaign(of).filters["ekf"]
        pose, position = (ekf.measures[what] for what in ("nees_pose", "rmse_position"))
        print(
            f"{name}: an EKF by `monte_carlo`, {len(of)} runs: {ekf.verdict}; pose NEES "
            f"{pose.value:.3f} [{pose.low:.3f}, {pose.high:.3f}], RMSE {position.value:.3f} m"
        )
        metrics.append(Metric(f"office, NEES, {name}: an EKF", pose.value, note=ekf.verdict))
    kept, correct, revisits = np.array([(c.kept, c.correct, c.revisits) for c in closures]).T.sum(1)
    seen = sum(each.recall * each.revisits for each in closures if each.revisits)
    metrics += [
        Metric("office, chi2 / degrees of freedom", np.mean(chi2), note="1 is honest"),
        Metric("office, precision of loops", correct / kept, note=f"of {kept}"),
        Metric("office, recall of revisits", seen / revisits, note=f"of {revisits}"),
    ]
    return metrics
