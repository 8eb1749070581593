"""Matches a second, errors of 361-beam scans, and errors over iterations."""

import json
import time

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.gate import Metric, child
from benchmarks.scan_matching.pairs import drawn
from jaxslam import matching
from jaxslam.simulation import laser
from jaxslam.simulation.walls import make_walls

BATCH = 64


def speed() -> list[Metric]:
    """On one core, in a process of its own."""
    return [
        Metric(name, value, low=300.0 if "point_to_line" in name else float("-inf"))
        for name, value in child("-m", "benchmarks.scan_matching.numbers").items()
    ]


def accuracy(runs: int) -> list[Metric]:
    """σ = 0.01 m on worlds that determine the pose; the share of the runs within the limits."""
    metrics = []
    matcher = matching.PointToLine()
    for world in ("square", "office"):
        pairs = drawn(world, runs, beams=361, sigma=0.01, seed=5)
        found = matching.match(matcher, pairs.reference, pairs.scan, pairs.start)
        error = np.abs(np.asarray(found.pose - pairs.truth))
        place = np.hypot(error[:, 0], error[:, 1])
        turn = np.degrees(error[:, 2])
        good = float(((place < 0.01) & (turn < 0.1)).mean())
        name = f"PL-ICP, {world}, 361 beams, σ 0.01 m"
        off, turned = (float(np.sqrt((each**2).mean())) for each in (place, turn))
        metrics += [
            Metric(f"{name}: position, root mean square [m]", off, high=0.01),
            Metric(f"{name}: heading, root mean square [°]", turned, high=0.1),
            Metric(f"{name}: share of runs below 1 cm and 0.1°", good),
            Metric(f"{name}: runs not usable", float((np.asarray(found.status) > 2).sum())),
        ]
    return metrics


def convergence(steps: int = 30) -> dict[str, np.ndarray]:
    """Distance [m] of each iterate from the last, without noise, in a round room with pillars."""
    room = make_walls(circles=[[0, 0, 4.0], [1.5, 1.2, 0.4], [-1.8, 0.6, 0.5], [0.3, -2.2, 0.6]])
    beams = 1440
    angles = 2 * np.pi * np.arange(beams) / beams
    exact = laser.Laser(angles, sigma=0.01, max_range=20.0)
    first, second = jnp.zeros(3), jnp.array([0.05, -0.04, 0.03])

    def seen(pose):
        ranges = laser.true_ranges(exact, room, pose)
        ray = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1)
        return matching.Points(ranges[:, None] * ray, ray, jnp.ones(beams, bool))

    reference, scan = seen(first), seen(second)
    start = second + jnp.array([0.12, -0.08, 0.06])
    found = {}
    for make in (matching.PointToPoint, matching.PointToLine):
        one = make(matching.IcpSettings(iterations=1))
        poses = [np.asarray(start)]
        while len(poses) < 400 and (len(poses) < 2 or np.any(poses[-1] != poses[-2])):
            poses.append(np.asarray(matching.match(one, reference, scan, poses[-1]).pose))
        away = np.stack(poses[: steps + 1]) - poses[-1]
        found[make.name] = np.hypot(away[:, 0], away[:, 1]) + 4.0 * np.abs(away[:, 2])
    return found


def orders(errors: dict[str, np.ndarray]) -> list[Metric]:
    """The order log(e_{k+2}/e_{k+1}) / log(e_{k+1}/e_k) is 1 where convergence is linear, 2 where
    quadratic; of PL-ICP the largest, as pairs of single points end it in the last steps."""
    p2p, p2l = errors["point_to_point"], errors["point_to_line"]
    ratio = p2p[2:12] / p2p[1:11]
    steep = p2l[p2l > 1e-13]
    order = [
        np.log(steep[k + 2] / steep[k + 1]) / np.log(steep[k + 1] / steep[k])
        for k in range(len(steep) - 2)
    ]
    return [
        Metric("ICP: factor of the error a step (linear)", float(np.median(ratio)), low=0.3),
        Metric("PL-ICP: order (quadratic)", float(max(order, default=np.inf)), low=1.8),
        Metric("ICP: steps to 1e-4 m", steps_to(p2p)),
        Metric("PL-ICP: steps to 1e-4 m", steps_to(p2l), high=6),
    ]


def steps_to(error: np.ndarray) -> float:
    """The first step at which the error is below 1e-4 m; infinite if none of those shown is."""
    return float(np.argmax(error < 1e-4)) if np.any(error < 1e-4) else np.inf


def measured_speed() -> dict[str, float]:
    """Matches a second of processor time, a batch of 361-beam scans of `square`, σ = 0.01 m."""
    pairs = drawn("square", BATCH, beams=361, sigma=0.01, seed=5)
    found = {}
    for dtype in (jnp.float64, jnp.float32):
        given = jax.tree.map(
            lambda a, dtype=dtype: a.astype(dtype) if jnp.issubdtype(a.dtype, jnp.floating) else a,
            (pairs.reference, pairs.scan, pairs.start),
        )
        for matcher in (matching.PointToLine(), matching.PointToPoint()):
            best = np.inf
            for _ in range(6):
                began = time.process_time()
                jax.block_until_ready(matching.match(matcher, *given))
                best = min(best, time.process_time() - began)
            name = f"{matcher.name}, 361 beams, {jnp.dtype(dtype).name}: matches a second and core"
            found[name] = BATCH / best
    return found


if __name__ == "__main__":
    from benchmarks.speed.timing import pin

    pin()
    jax.config.update("jax_enable_x64", True)
    print(json.dumps(measured_speed()))
