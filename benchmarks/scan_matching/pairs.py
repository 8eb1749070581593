"""Pairs of scans of exact worlds, with the bound of what they can tell."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam import matching
from jaxslam.math import se2
from jaxslam.simulation import laser
from jaxslam.simulation.scenarios import ROOMS

STEP = np.array([0.2, 0.1, 0.1])
"""The second pose lies up to so far from the first, uniformly [m, m, rad]."""
START = np.array([0.05, 0.05, 0.03])
"""Standard deviations of the start [m, m, rad]."""


class Pairs(NamedTuple):
    """Scans of a world, two a run."""

    reference: matching.Points
    scan: matching.Points
    truth: jax.Array
    """(runs, 3) of the second pose in the frame of the first"""
    start: jax.Array
    poses: tuple[jax.Array, jax.Array]
    """(runs, 3) each, in the world"""
    world: laser.LaserWorld


def drawn(name: str, runs: int, *, beams: int = 180, sigma: float = 0.03, seed: int = 0) -> Pairs:
    """First poses are drawn from the world's path; a second pose within walls nearby."""
    world = ROOMS[name](beams)
    exact = dataclasses.replace(world.laser, sigma=sigma, dropout=0.0)
    world = dataclasses.replace(world, laser=exact)
    path = np.asarray(laser.scan_world(world, jax.random.key(seed)).pose)
    keys = jax.random.split(jax.random.key(seed + 1), runs)

    def one(key):
        parts = jax.random.split(key, 5)
        first = jnp.asarray(path)[jax.random.randint(parts[0], (), 0, len(path))]
        step = jax.random.uniform(parts[1], (3,), minval=-1.0) * STEP
        start = step + jax.random.normal(parts[2], (3,)) * START
        second = se2.compose(first, step)
        scans = [
            matching.points(laser.scan(exact, world.walls, pose, k), exact.max_range)
            for pose, k in zip((first, second), parts[3:], strict=True)
        ]
        return *scans, step, start, (first, second)

    return Pairs(*jax.jit(jax.vmap(one))(keys), world)


class Known(NamedTuple):
    """What two scans determine of a relative pose."""

    seen: np.ndarray
    """(runs, 3, D) functionals of the error that the scans determine"""
    free: np.ndarray
    """(runs, 3, 3 - D) motions of the second pose that change no range"""
    bound: np.ndarray
    """(runs, 3, 3) Cramér-Rao bound if the walls were known, within what is determined"""


def known(pairs: Pairs) -> Known:
    """The bound by the exact world: J_a C_a J_aᵀ + J_b C_b J_bᵀ, C of `scan_information`, J of
    `se2.between`."""
    seen, free, bound = [], [], []
    by_pose = jax.jit(jax.vmap(se2.between_jacobians))(*pairs.poses)
    for run, (by_a, by_b) in enumerate(zip(*map(np.asarray, by_pose), strict=True)):
        told = [
            laser.scan_information(pairs.world.laser, pairs.world.walls, np.asarray(pose[run]))
            for pose in pairs.poses
        ]
        motions = by_b @ told[1].directions.T
        left = np.linalg.svd(motions)[0]
        seen.append(left[:, motions.shape[1] :])
        free.append(motions)
        bound.append(by_a @ told[0].bound @ by_a.T + by_b @ told[1].bound @ by_b.T)
    return Known(np.stack(seen), np.stack(free), np.stack(bound))
