"""A robot that may be anywhere, then is carried away: particles against the EKF in a known map.

`circle`, its map known: landmarks by tag, seen between 1 and 5 m. As far as the filters know the
robot starts anywhere; it drives 150 s, is put down at the other side of the ring without being
told, and drives 150 s more. Monte-Carlo localization with at most so many particles, and with five
times the sensor's σ, as a precise sensor needs more particles than there are; the EKF told the mean
and the covariance of the whole box; and the EKF told where it truly starts, with a gate of 99.9 %.

A robot is found where the estimate is within half a metre, from then to the end of that part. The
gates: particles find it in nine of ten runs in either part, the EKF with a gate after kidnapping in
one of ten at most, and fewer than a fifth of the particles are in use (median) at the end of either
part. The EKF without a gate has none: as tags are known, what it measures may pull it back.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.gate import Metric, show
from jaxslam import run, sensors, simulate
from jaxslam.filters import Localization, ParticleLocalization
from jaxslam.filters._particles import pose_particles
from jaxslam.math.stats import sigma_gate
from jaxslam.simulation.scenarios import circle

BOX = np.array([[-14.0, -4.0], [14.0, 23.0]])
HALF = 150  # steps of 1 s
FOUND = 0.5  # [m]
PARTICLES = 5000


def carried(world, key):
    """True poses (2·HALF, 3) and the log of a robot that is carried across at half time."""
    radius = 0.25 / np.deg2rad(1.5)
    keys, poses, logs = jax.random.split(key), [], []
    for pose, own in (((0.0, 2 * radius, np.pi), keys[0]), ((0.0, 0.0, 0.0), keys[1])):
        truth, log = simulate(dataclasses.replace(world, pose=pose), own)
        poses.append(truth.pose)
        logs.append(log)
    return jnp.concatenate(poses), jax.tree.map(lambda a, b: jnp.concatenate([a, b]), *logs)


def filters_of(world):
    """Filter, and what it is told of the start, by name."""
    blunt = sensors.RelativePosition(0.5**2 * np.eye(2))
    anywhere = pose_particles.Box(BOX).moments(jnp.zeros(0).dtype)
    known = jnp.array([0.0, 0.5 / np.deg2rad(1.5), np.pi]), jnp.zeros((3, 3))
    models = world.motion, world.sensor, world.landmarks
    return {
        "particles": (
            ParticleLocalization(
                world.motion,
                blunt,
                world.landmarks,
                PARTICLES,
                box=BOX,
                start="uniform",
                gate=sigma_gate(5, 2),
            ),
            *anywhere,
        ),
        "EKF, box, no gate": (Localization(*models), *anywhere),
        "EKF, start, gate": (Localization(*models, gate=0.999), *known),
    }


def histories(runs):
    """By filter: position error [m] (runs, 2·HALF), and its `Info`."""
    world = circle(HALF)
    keys = jax.random.split(jax.random.key(0), runs)
    poses, logs = jax.jit(jax.vmap(partial(carried, world)))(keys)
    out = {}
    for name, (filter, pose, cov) in filters_of(world).items():

        def one(row, filter=filter, pose=pose, cov=cov):
            log, key = row
            trace = run(filter, log, pose, cov, key)
            return trace.estimate.pose, trace.info

        found, info = jax.jit(partial(jax.lax.map, one))((logs, keys))
        error = np.linalg.norm(np.asarray(found)[..., :2] - np.asarray(poses)[..., :2], axis=2)
        out[name] = error, info
    return out


def seconds_to_find(error):
    """(runs,) the step from which an error (runs, T) stays within FOUND, or inf."""
    late = error >= FOUND
    last = np.where(late.any(axis=1), error.shape[1] - np.argmax(late[:, ::-1], axis=1), 0)
    return np.where(last < error.shape[1], last, np.inf)


def measure(quick: bool = False) -> list[Metric]:
    runs = 4 if quick else 12
    traces, rows, metrics = histories(runs), {}, []
    for name, (error, _) in traces.items():
        for part, at in (("anywhere", slice(0, HALF)), ("carried away", slice(HALF, None))):
            after = seconds_to_find(error[:, at])
            found = np.isfinite(after)
            rows[f"{name}, {part}"] = {
                "found": found.mean(),
                "after [s]": np.median(after[found]) if found.any() else np.inf,
                "error at its end [m]": np.median(error[:, at][:, -1]),
            }
            gate = {"low": 0.9} if name == "particles" else {}
            if part == "carried away" and name == "EKF, start, gate":
                gate = {"high": 0.1}
            metrics.append(Metric(f"{name}, {part}: share found", found.mean(), **gate))
    show(f"circle: {runs} runs of 2 × {HALF} s", rows)
    found = traces["particles"][1].extra["particles"]
    active, injected = np.median(np.asarray(found.active), axis=0), np.asarray(found.injected)
    for part, at in (("anywhere", HALF - 1), ("carried away", 2 * HALF - 1)):
        metrics.append(Metric(f"particles in use, end of {part}", active[at], high=0.2 * PARTICLES))
    return [
        *metrics,
        Metric("injected a run, before it is carried", injected[:, :HALF].sum(1).mean()),
        Metric("injected a run, after", injected[:, HALF:].sum(1).mean()),
        Metric("steps in which no weight was left", float(found.underflow.sum())),
        Metric("steps at the capacity, a run", float(found.capped.sum(1).mean())),
    ]
