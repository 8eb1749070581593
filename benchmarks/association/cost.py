"""What association costs beside the correction it serves: 20 measurements, a map of 200.

And how long the whole pipeline compiles: association, life and merging of landmarks, with that map
and scan, under `lax.scan`; and its gradient.
"""

import dataclasses
import time

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.association import rules
from benchmarks.speed.timing import together
from jaxslam import life, run
from jaxslam.core.slots import Joint
from jaxslam.core.types import Log, Scan
from jaxslam.filters import EkfSlam, Merging
from jaxslam.filters._ekf.correction import correct_in_turn
from jaxslam.filters._ekf.predicted_measurements import prediction_of
from jaxslam.simulation.scenarios import cloister

COUNT, SEEN, RUNS = 200, 20, 16
METHODS = rules(0.99)


def problem(sensor, seed):
    """A robot in a map of 200 correlated landmarks, and a scan of the 20 nearest."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-30, 30, size=(COUNT, 2))
    points = points[np.argsort((points**2).sum(axis=1))]
    root = 0.02 * rng.normal(size=(3 + 2 * COUNT, 5))
    cov = root @ root.T + 0.01 * np.eye(3 + 2 * COUNT)
    cov[:3, :3] *= 0.1
    cov[:3, 3:] *= 0.1**0.5
    cov[3:, :3] *= 0.1**0.5
    pose = jnp.zeros(3)
    z = jax.vmap(sensor.observe, (None, 0))(pose, jnp.asarray(points[:SEEN]))
    z = z + rng.normal(size=z.shape) * np.array([0.1, 0.017])
    joint = Joint(
        pose, jnp.asarray(points), jnp.asarray(cov), jnp.ones(COUNT, bool), jnp.arange(COUNT), ()
    )
    return joint, Scan(z, jnp.arange(SEEN), jnp.ones(SEEN, bool))


def measure():
    """Seconds of one scan: the correction, and each method."""
    sensor = cloister().sensor
    joint, scan = jax.tree.map(
        lambda *leaves: jnp.stack(leaves), *(problem(sensor, seed) for seed in range(RUNS))
    )
    ekf = EkfSlam(cloister().motion, sensor, COUNT)

    def correct(joint, scan):
        return correct_in_turn(ekf, sensor, joint, scan.z, scan.tag, scan.valid, None)[0]

    def find(method):
        return lambda joint, scan: tuple(method(prediction_of(ekf, sensor, joint), scan))

    programs = {"correction": correct} | {name: find(method) for name, method in METHODS.items()}
    actions = {}
    for name, program in programs.items():
        compiled = jax.jit(jax.vmap(program)).lower(joint, scan).compile()
        actions[name] = lambda compiled=compiled: jax.block_until_ready(compiled(joint, scan))
    seconds = together(actions)
    return {name: value / RUNS for name, value in seconds.items()}


def compile_seconds():
    """Of `run` with everything that decides about landmarks, traced and compiled; {method: s}."""
    world, found = cloister(), {}
    scans = Scan(jnp.ones((50, SEEN, 2)), jnp.full((50, SEEN), -1), jnp.ones((50, SEEN), bool))
    log = Log(jnp.ones((50, len(world.motion.controls))), scans)
    near = life.Existence(lambda pose, point: ((point - pose[:2]) ** 2).sum() < 9.0, replace=True)

    def loss(noise, log, method):
        sensor = dataclasses.replace(world.sensor, noise_cov=lambda z: noise)
        plain = EkfSlam(world.motion, sensor, COUNT, associate=METHODS[method], life=near)
        filter = Merging(plain, 0.3)
        trace = run(filter, log, world.pose, world.pose_cov, jax.random.key(0))
        return trace.info.log_likelihood.sum(), trace

    noise = jnp.diag(jnp.array([0.01, 0.0003]))
    for method in METHODS:
        programs = {method: lambda noise, log, m=method: loss(noise, log, m)}
        if method == "nearest":
            programs["nearest, gradient"] = jax.grad(
                lambda noise, log: loss(noise, log, "nearest")[0]
            )
        for name, program in programs.items():
            began = time.perf_counter()
            jax.jit(program).lower(noise, log).compile()
            found[name] = time.perf_counter() - began
    return found
