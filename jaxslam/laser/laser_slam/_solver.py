"""Laser SLAM: from raw odometry and scans to a path, a graph, its loops and a map."""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from jaxslam import graphs
from jaxslam.core.validation import refusals_of, require
from jaxslam.laser.laser_slam import _end_covariances as end_covariances
from jaxslam.laser.laser_slam._assembly import ROOM
from jaxslam.laser.laser_slam._log_map import frame_of, map_of
from jaxslam.laser.laser_slam._loops.rounds import close_loops
from jaxslam.laser.laser_slam._odometry.log_odometry import laser_odometry
from jaxslam.laser.laser_slam._odometry.raw import steps_of
from jaxslam.laser.laser_slam._odometry.tracking import Odometry
from jaxslam.laser.laser_slam._records import LogOfScans, LoopOutcome, Settings, Solved
from jaxslam.laser.laser_slam._scan_points import laser_log, scans_of
from jaxslam.math import numpy_poses as poses
from jaxslam.math._arrays import float64

DEFAULT = Settings()


def solve(
    log: LogOfScans,
    settings: Settings = DEFAULT,
    *,
    progress: Callable[[str, int, int], object] | None = None,
) -> Solved:
    """The path, graph, loops and map of a laser log, from its raw odometry and scans.

    Laser odometry places each scan among the keyframes before it; loops between keyframes are
    found by position and by appearance, and those that agree are edges of the graph; the map is of
    all scans at the optimum. Unused data are counted, and the run continues: scans with too few
    points have raw odometry, steps of raw odometry that cannot be are taken to be unknown.

    Args:
        log: `datasets.LaserLog`, or `ScanLog`.
        settings: the numbers.
        progress: called as progress(stage, done, of).
    Raises:
        ValueError: on a log whose parts do not fit, or are not finite.
    """
    with refusals_of("laser_slam.solve"):
        require("log", log, laser_log)
    seconds: dict[str, float] = {}
    began = time.perf_counter()

    def lap(stage: str) -> None:
        nonlocal began
        now = time.perf_counter()
        seconds[stage], began = now - began, now

    def progress_of(stage: str) -> Callable[[int, int], object] | None:
        return None if progress is None else lambda done, of: progress(stage, done, of)

    raw = np.asarray(log.raw, np.float64)
    scans = scans_of(log, settings)
    steps = steps_of(raw, settings, np.asarray(log.time, float), scans.changed, log.odometry_known)
    lap("reading the scans")
    odometry = laser_odometry(scans, steps, settings, raw[0], progress_of("odometry"))
    lap("odometry")
    with float64():  # a step that is hardly known and a match differ too much for 32 bits
        graph, loops, left_out = close_loops(scans, odometry, settings, progress_of("loop closing"))
        lap("loop closing")
        base, z, z_cov, path, cov = _scans_on_keyframes(graph, odometry)
        squared = graphs.squared_residuals(graph, room=ROOM)
    chi2 = float(sum(np.asarray(table).sum() for table in squared.values())) if squared else 0.0
    lap("marginals")
    # A common frame, so that the maps before and after compare cell by cell.
    frame = frame_of(log, [path, odometry.poses], settings)
    # The two maps side by side.
    with ThreadPoolExecutor(2) as pool:
        paths = path, odometry.poses
        maps = pool.map(lambda path: map_of(log, path, scans.usable, frame, settings), paths)
        map_after, map_before = maps
    lap("map")
    counts = {
        "scans": len(scans.usable),
        "keyframes": len(odometry.keyframe),
        "scans with too few points": int((~scans.usable).sum()),
        "scans by raw odometry alone": int((~odometry.matched[1:]).sum()),
        "scans whose match is in doubt": int(odometry.doubted.sum()),
        "jumps of raw odometry": int((steps.jump | odometry.refuted).sum()),
        "steps in which raw odometry is frozen": int(steps.frozen.sum()),
        "steps in which raw odometry lags": int(steps.lags.sum()),
        "scans stamped before their predecessor": int((np.diff(log.time) < 0).sum()),
        "loops matched": len(loops.outcome),
    }
    for outcome in LoopOutcome:
        counts[f"loops {outcome.name.lower()}"] = int((loops.outcome == outcome).sum())
    counts["keyframes and candidates of loops left out, being too many"] = left_out
    return Solved(
        time=np.asarray(log.time, np.float64),
        poses=path,
        odometry=odometry.poses,
        raw=raw,
        cov=cov,
        doubted=odometry.doubted,
        keyframe=odometry.keyframe,
        base=base,
        z=z,
        z_cov=z_cov,
        graph=graph,
        start=graph._replace(poses=odometry.poses[odometry.keyframe]),
        loops=loops,
        map=map_after,
        map_before=map_before,
        counts=counts,
        chi2=chi2,
        dof=graphs.degrees_of_freedom(graph) if len(graph.poses) > 1 else 0,
        seconds=seconds,
    )


def _scans_on_keyframes(
    graph: graphs.Graph, odometry: Odometry
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """`base`, `z`, `z_cov`, `poses` and `cov` of `Solved`, from the poses of the keyframes."""
    keyframe = odometry.keyframe
    at = np.asarray(graph.poses, np.float64)
    scan = np.arange(len(odometry.poses))
    base = np.searchsorted(keyframe, scan, side="right") - 1
    is_key = keyframe[base] == scan
    z = np.where(is_key[:, None], 0.0, odometry.z)
    z_cov = np.where(is_key[:, None, None], 0.0, odometry.cov)
    path = poses.compose(at[base], z)
    if len(at) == 1:
        marginals = np.zeros((1, 3, 3))
    else:
        # No iteration: the graph is at its optimum, and only the factor is needed.
        optimum = graphs.optimize(graph, room=ROOM, iterations=0)
        marginals = np.asarray(graphs.marginals(optimum, room=ROOM).poses, np.float64)
    # The marginals are of coordinates in the world's frame.
    heading = at[base, 2]
    end_cov = end_covariances.turns(-heading) @ marginals[base] @ end_covariances.turns(heading)
    end_cov = end_covariances.composed_cov(end_cov, z, z_cov)
    return base, z, z_cov, path, end_covariances.of_coordinates(end_cov, path)
