"""Walls from a laser's scans: segments, and EKF-SLAM with the lines and each one's covariance.

In exact rooms (180 beams, σ = 2 cm, 2 % dropouts) every n-th scan is divided into segments; each
line enters the EKF with the covariance of its own fit. Which wall a line is of is told by the true
pose (the world's wall ids); lines that are of no wall are counted and left out. NEES of the lines
against the walls (honest: 2), NEES of the pose (3) and NIS/dof (1) of the EKF.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.gate import Metric, show
from jaxslam import features, filters, scenarios, sensors
from jaxslam.consistency import block_nees, pose_error
from jaxslam.core.types import Beams, Scan
from jaxslam.math.stats import t_quantile
from jaxslam.simulation import laser
from jaxslam.simulation._wall_geometry import wall_lines

PLACES, FAR = 16, (0.4, 0.3)
"""Measurement slots of a scan; from its wall a line is at most so far, [m] and [rad]."""


def lines_of(world, lines, pose, beams: Beams):
    """z, cov, tag, valid of one scan in PLACES rows; NEES of its lines; how many are of no wall."""
    found = features.segments(beams, sigma=world.laser.sigma, max_range=world.laser.max_range)
    x, y, theta = pose
    normal = np.stack([np.cos(lines[:, 1]), np.sin(lines[:, 1])])
    true = np.stack([lines[:, 0] - [x, y] @ normal, lines[:, 1] - theta], axis=1)
    gap = found.line[:, None] - true[None]
    gap[..., 1] = np.angle(np.exp(1j * gap[..., 1]))
    tag = (np.abs(gap) / FAR).sum(axis=2).argmin(axis=1)
    gap = gap[np.arange(len(tag)), tag]
    mine = (np.abs(gap) < FAR).all(axis=1)
    # A wall in two pieces is measured once, by the longer one.
    for k in np.argsort(-found.size):
        mine[k] &= not (mine & (tag == tag[k]) & (found.size > found.size[k])).any()
    rows = np.flatnonzero(mine)[:PLACES]
    z, cov = np.zeros((PLACES, 2)), np.tile(np.eye(2), (PLACES, 1, 1))
    tags, valid = np.full(PLACES, -1), np.arange(PLACES) < len(rows)
    z[valid], cov[valid], tags[valid] = found.line[rows], found.cov[rows], tag[rows]
    nees = np.einsum("ki,kij,kj->k", gap[rows], np.linalg.inv(found.cov[rows]), gap[rows])
    return (z, cov, tags, valid), nees, len(tag) - len(rows)


def drive(world, count: int, control, scans) -> Any:
    """The EKF's poses, covariances, and NIS and dof by step; a filter is made for each line."""
    key = jax.random.key(0)

    def filter_of(cov):
        return filters.EkfSlam(world.motion, sensors.Line(cov), count)

    def step(state, row):
        control, lines = row
        state = filter_of(jnp.eye(2)).predict(state, control, key)

        def one(state, line):
            z, cov, tag, valid = (part[None] for part in line)
            state, info = filter_of(cov[0]).update(state, Scan(z, tag, valid), key)
            return state, (info.nis.sum(), info.dof.sum())

        state, (nis, dof) = jax.lax.scan(one, state, lines)
        return state, (state.pose, state.cov[:3, :3], nis.sum(), dof.sum())

    start = filter_of(jnp.eye(2)).init(jnp.asarray(world.pose, float), jnp.zeros((3, 3)))
    return jax.lax.scan(step, start, (control, scans))[1]


def judge(name: str, runs: int, every: int) -> tuple[float, float, float]:
    """NEES of lines, NEES of the pose, NIS/dof; prints them with their intervals."""
    world = scenarios.ROOMS[name]()
    lines, _ = wall_lines(world.walls)
    keys = jax.random.split(jax.random.key(0), runs)
    logs = jax.device_get(jax.jit(jax.vmap(lambda key: laser.scan_world(world, key)))(keys))
    steps, nees, none = logs.pose.shape[1], [], 0
    shape = (runs, steps, PLACES)
    cov, tag = np.tile(np.eye(2), (*shape, 1, 1)), np.full(shape, -1)
    scans = np.zeros((*shape, 2)), cov, tag, np.zeros(shape, bool)
    for run, t in np.ndindex(runs, -(-steps // every)):
        at = run, t * every
        row, each, spurious = lines_of(
            world, lines, logs.pose[at], Beams(*(part[at] for part in logs.beams))
        )
        for whole, part in zip(scans, row, strict=True):
            whole[at] = part
        nees.append(each)
        none += spurious
    go = jax.jit(jax.vmap(lambda control, scans: drive(world, len(lines), control, scans)))
    pose, cov, nis, dof = (np.asarray(part) for part in go(logs.control, scans))
    measured = slice(every, None)  # P0 = 0 at first
    estimate, error = pose[:, measured], pose_error(logs.pose[:, measured], pose[:, measured])
    of_pose, regular = block_nees(estimate, error, error, cov[:, measured])["pose"]
    of_pose, of_lines = np.ma.array(of_pose, mask=~regular).mean(axis=1), np.concatenate(nees)
    of_pose = of_pose.compressed()
    ratio = nis.sum(axis=1) / dof.sum(axis=1)
    error = np.sqrt(((logs.pose - pose)[:, -1, :2] ** 2).sum(axis=1).mean())
    found = {"NEES of a line (2)": of_lines, "pose NEES (3)": of_pose, "NIS/dof (1)": ratio}
    rows = {}
    for what, values in found.items():
        half = t_quantile(0.975, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values))
        mean, median = f"{values.mean():.3f} ± {half:.3f}", f"{np.median(values):.3f}"
        rows[what] = {"mean": mean, "median": median}
    show(f"{name}: {runs} runs × {steps} steps, a scan every {every}", rows)
    share = none / (none + len(of_lines))
    print(f"{len(of_lines):,} lines, {share:.1%} more of no wall or in pieces, left out")
    print(f"final position RMSE {error:.3f} m", flush=True)
    return tuple(float(values.mean()) for values in found.values())


def round_walls(beams: int) -> float:
    """Lines a scan of the circular room, over four runs."""
    world = scenarios.circular_room(beams=beams)
    keys = jax.random.split(jax.random.key(0), 4)
    logs = jax.device_get(jax.jit(jax.vmap(lambda key: laser.scan_world(world, key)))(keys))
    scans = zip(*(part.reshape(-1, beams) for part in logs.beams), strict=True)
    options = {"sigma": world.laser.sigma, "max_range": world.laser.max_range}
    return float(np.mean([len(features.segments(Beams(*scan), **options).line) for scan in scans]))


def measure(quick: bool = False) -> list[Metric]:
    metrics = [
        Metric(f"circular_room, {beams} beams: lines a scan", round_walls(beams), high=0.1)
        for beams in (90, 180, 360, 720)
    ]
    for name, every in (("square", 4), ("office", 8)):
        line, pose, ratio = judge(name, 10 if quick else 100, every)
        metrics += [
            Metric(f"{name}: NEES of a line", line, low=1.6, high=2.8, note="honest: 2"),
            Metric(f"{name}: pose NEES", pose, high=6.0, note="honest: 3"),
            Metric(f"{name}: NIS/dof", ratio, low=0.85, high=1.3, note="honest: 1"),
        ]
    return metrics
