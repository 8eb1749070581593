"""The command `jaxslam localize`: Monte-Carlo localization from raw odometry and scans."""

import argparse
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PyTree

from jaxslam import datasets, motion
from jaxslam._cli.campaigns.piecewise import PiecewiseRun, run_in_pieces
from jaxslam._cli.recorded import laser_log
from jaxslam.consistency.campaign._progress import Progress
from jaxslam.core.types import Info
from jaxslam.datasets import LaserLog
from jaxslam.datasets._laser_logs.bag_messages import is_bag
from jaxslam.laser import grids, laser_slam
from jaxslam.laser.grids import Grid
from jaxslam.math._odometry_jumps import odometry_jumps
from jaxslam.math.numpy_poses import compose
from jaxslam.results import report
from jaxslam.results._files import Files, Json

START_DEVIATION = np.array([0.2, 0.2, np.deg2rad(10.0)])
"""Standard deviations of a pose at the start that the user names [m, m, rad]."""

ODOMETRY_NOISE = (0.05, 0.03, 0.02, 0.01)
"""α of `motion.OdometryNoise`: a straight step of 0.7 m has σ = 10 cm ahead and 7° in each turn.

Raw odometry of intel, freiburg-101 and edmonton differs from the corrected poses by 4 cm, 5 cm and
1.7° to 3.5° (RMS) per step of 0.5 m to 1 m; the margin is for robots with worse odometry."""


class Tuning(NamedTuple):
    """Numbers of `grids.GridLocalization` that depend on what is known of the start."""

    exponent: float
    """exponent of the likelihood of a scan"""
    forget: tuple[float, float] | None
    """rates of the recovery from a wrong pose; None without recovery"""
    sigma: float
    """width of the likelihood field [m]"""


TRACKING = Tuning(exponent=0.2, forget=None, sigma=0.1)
"""Tuning for a start at a known pose: without recovery, which takes scans that the map does not
explain for a lost robot."""

ANYWHERE = Tuning(exponent=0.1, forget=(0.05, 0.5), sigma=0.2)
"""Tuning for a start anywhere, with few particles near the truth: a flatter likelihood keeps
particles that are only roughly right."""

BEAMS = 60
"""Approximate number of beams of a scan that enter the weights."""

MAX_POSE_ERROR = 0.5
"""Distance from the reference within which a pose counts as correct [m]."""

LAST_SCANS, MAX_RANGE_ERROR, MIN_SHARE = 10, 0.3, 0.75
"""The robot is localized if at least `MIN_SHARE` of the beams of the last scans have the range that
the map predicts, within `MAX_RANGE_ERROR` [m]. Chosen on the runs in `benchmarks/NOTES.md`."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `jaxslam localize`."""
    parser.add_argument("map", metavar="MAP.yaml", help="a map of ROS")
    laser_log.add_options(parser, run_localization, map_is_made=False)
    parser.add_argument(
        "--start",
        metavar="POSE",
        help="where the robot starts: file (the pose beside the first scan), global (anywhere that "
        "is free), or X,Y,HEADING [m, m, deg] (default: file, or global if the file has no poses)",
    )
    parser.add_argument(
        "--particles",
        type=int,
        metavar="N",
        default=2000,
        help="largest number of particles (default: 2000)",
    )
    parser.add_argument(
        "--seed",
        type=int,
        metavar="N",
        default=0,
        help="seed of the particles' random numbers (default: 0)",
    )


def run_localization(log: LaserLog, options: argparse.Namespace) -> laser_log.Job:
    """Localize the robot in the map, from raw odometry and scans.

    By the likelihood field and KLD resampling; a robot that starts anywhere has recovery, too.
    The poses in the file score the result, and are otherwise used only by the start `file`.
    """
    if is_bag(options.map):
        raise ValueError(f"expected a map of ROS, NAME.yaml, got {options.map}")
    grid = datasets.read_map(options.map)
    if not np.any(np.asarray(grid.log_odds) < 0):
        raise ValueError(f"{options.map}: the map has no free cell")
    start = options.start or ("file" if log.placed else "global")
    pose = None
    if start == "file":
        laser_log.check_poses(log)
        pose = np.asarray(log.corrected[0])
    elif start != "global":
        pose = laser_log.pose_of("--start", start, "file, global or ")
    if pose is not None:
        x, y, heading = pose
        cell = grids.to_cells(jnp.asarray(grid.origin), grid.resolution, jnp.asarray(pose[:2]))
        if not np.all((np.asarray(cell) >= 0) & (np.asarray(cell) <= grid.log_odds.shape[::-1])):
            raise ValueError(
                f"--start: the pose ({x:g} m, {y:g} m, {np.rad2deg(heading):g}°) is off the map "
                f"{options.map}"
            )
    # Laser odometry, if the log has none, or one that jumps.
    is_logged = len(log.time) == 1 or bool(log.odometry_known[1:].any())
    jumps = int(odometry_jumps(log.raw, log.time).sum())
    raw, odometry = log.raw, "of the log"
    if not is_logged:
        odometry = "laser odometry, since the log has none"
    elif jumps:
        odometry = f"laser odometry, since that of the log jumps {jumps} times"
    if jumps or not is_logged:
        raw = laser_slam.solve(log).odometry
    result = _run_particles(log, grid, pose, raw, options)
    path = result.path
    fit = share_as_predicted(grid, np.asarray(path.pose)[-LAST_SCANS:], log)
    head = {"job": "localization", "map": str(options.map), "start": start, "odometry": odometry}
    summary = head | _summary(result, options.particles, fit)
    summary |= laser_log.score_or_reason(log, lambda: scores(np.asarray(path.pose), log.corrected))

    def draw() -> Files:
        from jaxslam.results import plot  # matplotlib is slow to load
        from jaxslam.results.plot._style import pictures

        figure = plot.grid_figure(
            grid,
            poses=path.pose,
            width=plot.PAGE,
            others={"poses in the file": log.corrected} if log.placed else {},
            title=f"{log.name}: localization",
        )
        return {**pictures("localization", figure, options.figures)}

    files: Files = {
        "trajectory.csv": report.trajectory_csv(log.time, path),
        "trajectory.tum": report.trajectory_tum(log.time, path),
    }
    return laser_log.Job(summary, files, drawings={"localization": draw})


def _run_particles(
    log: LaserLog,
    grid: Grid,
    pose: Float[np.ndarray, "3"] | None,
    odometry: Float[np.ndarray, "K 3"],
    options: argparse.Namespace,
) -> PiecewiseRun:
    """Run the particle filter over the log.

    pose: pose at the start; None for anywhere.
    """
    tuning = ANYWHERE if pose is None else TRACKING
    filter = grids.GridLocalization(
        grid,
        grids.LikelihoodField(tuning.sigma, max_range=log.max_range, mount=log.mount),
        motion.Odometry(motion.OdometryNoise(ODOMETRY_NOISE)),
        options.particles,
        start="uniform" if pose is None else "gaussian",
        exponent=tuning.exponent,
        forget=tuning.forget,
        stride=max(1, np.shape(log.beams.range)[1] // BEAMS),
    )
    rows = grids.beam_log(motion.odometry_controls(odometry), log.beams)

    def particles(info: Info) -> PyTree:
        assert info.extra is not None
        return info.extra["particles"]

    with Progress(f"{log.name}, localization", "scans") as progress:
        return run_in_pieces(
            filter,
            jax.tree.map(jnp.asarray, rows),
            np.zeros(3) if pose is None else pose,
            np.diag(START_DEVIATION**2),
            progress=progress,
            seed=options.seed,
            at=np.array([len(log.time) - 1]),
            watch=lambda state: (state.pose, state.log_weight),
            keep=particles,
        )


def _summary(result: PiecewiseRun, particles: int, fit: float) -> Json:
    """The entries of the summary on the particles, and on whether the robot is localized."""
    cloud, log_weight = (np.asarray(part)[-1] for part in result.watched)
    groups = grids.clusters(cloud, log_weight)
    info = result.kept
    agree = bool(groups.weight[0] > 0.5)
    return {
        "particles": particles,
        "particles in use, mean": float(np.mean(info.active)),
        "particles drawn anywhere, to recover": int(np.sum(info.injected)),
        "scans that left no particle a weight": int(np.sum(info.underflow)),
        "particles off the map or in a wall, largest share": float(
            np.max(info.blocked / info.active)
        ),
        "hypotheses at the end": len(groups.weight),
        "weight of the heaviest": float(groups.weight[0]),
        "particles agree at the end": agree,
        f"beams of the last {LAST_SCANS} scans within {MAX_RANGE_ERROR:g} m of the map's range, "
        "share": fit,
        "localized at the end": (
            "no: hypotheses disagree"
            if not agree
            else "yes"
            if fit >= MIN_SHARE
            else f"no: less than {MIN_SHARE:.0%} of the beams fit the map"
        ),
        "final pose [m, m, rad]": [float(value) for value in result.path.pose[-1]],
    }


def share_as_predicted(grid: Grid, poses: Float[np.ndarray, "n 3"], log: LaserLog) -> float:
    """The share of beams whose range is within `MAX_RANGE_ERROR` of the range in the map.

    Of the returned beams of the last n scans, at the estimated poses; 0 without such beams.
    """
    scans = jax.tree.map(lambda part: part[-len(poses) :], log.beams)
    rays = grids.ray_map(grid, method="cells")
    cast = jax.jit(jax.vmap(lambda pose, angles: grids.cast(rays, pose, angles, log.max_range)))
    predicted = np.asarray(cast(compose(poses, log.mount), scans.angle))
    met, _ = scans.returns(log.max_range)
    fits = met & (np.abs(predicted - scans.range) < MAX_RANGE_ERROR)
    return float(fits.sum() / max(met.sum(), 1))


def scores(pose: Float[np.ndarray, "K 3"], reference: Float[np.ndarray, "K 3"]) -> Json:
    """Distances from the poses in the file, which must be in the frame of the map."""
    distance = np.hypot(*(pose[:, :2] - reference[:, :2]).T)
    turn = np.rad2deg(np.abs(np.angle(np.exp(1j * (pose[:, 2] - reference[:, 2])))))
    near = distance < MAX_POSE_ERROR
    far = np.flatnonzero(~near)
    near_from = 0 if not len(far) else int(far[-1]) + 1
    return {
        "from the poses in the file, median [m]": float(np.median(distance)),
        "from the poses in the file, median [deg]": float(np.median(turn)),
        "from the poses in the file, largest of the second half [m]": float(
            distance[len(distance) // 2 :].max()
        ),
        f"share of scans within {MAX_POSE_ERROR:g} m": float(near.mean()),
        f"within {MAX_POSE_ERROR:g} m from scan … on": (
            near_from if near_from < len(distance) else "none"
        ),
    }
