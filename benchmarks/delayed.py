"""Bearing-only landmarks: initialized late, or at once in inverse depth; the same draws.

`cloister` with a camera, as in `benchmarks.bearing`: one bearing of 1° a landmark and step, the
start known, identities known. Every third column stands, so that 100 runs with a table of stored
measurements take minutes. `delayed` promotes an intersection that was confirmed three times,
`delayed, once` once; the landmarks of `inverse_depth` exist from the first bearing on.

The wait is in steps from the first bearing of a landmark to the landmark. A landmark is false when
it ends farther than 1 m from the column of its name. The robot's heading gains 1.1° (1 σ) a step
while no landmark holds it, so here waiting costs more than it saves: the yardstick of the pose NEES
is 3, a few runs go wrong, and the gates only ask that most do not and that no landmark is false.

The second world has no identities: a robot in a circle of 16 m among five landmarks, with little
noise (`still`), and again with two bearings of nothing a step (`clutter`). A bearing that is of no
landmark by the chi-square gate meets all others. There, false is farther than 1 m from any.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

import jaxslam
from benchmarks.gate import Metric, show
from jaxslam import Scenario, motion, sensors
from jaxslam.association import Nearest
from jaxslam.filters import DelayedSlam, EkfSlam, Hypotheses, Promotion, StoredMeasurements
from jaxslam.math._gaussians import mahalanobis_squared
from jaxslam.math.angles import wrap
from jaxslam.simulation.scenarios import cloister

SIGMA = np.deg2rad(1.0)
FALSE = 1.0
BLOCK, EVERY = 20, 3


def named(every=EVERY):
    world = cloister()
    columns = world.landmarks[::every]
    camera = sensors.BearingOnly([[SIGMA**2]], free=([5.0], [[2.5**2]]))
    rays = sensors.BearingInverseDepth([[SIGMA**2]], min_distance=1.0)
    scenario = dataclasses.replace(
        world, name="cloister", sensor=camera, landmarks=columns, filter_options={}, published={}
    )
    count = len(columns)
    parts = world.motion, camera, count
    tables = {
        "stored": StoredMeasurements(capacity=6 * count),
        "hypotheses": Hypotheses(capacity=2 * count),
    }
    once = Promotion(persistence=2, lead=0)
    return scenario, {
        "delayed": DelayedSlam(*parts, **tables),
        "delayed, once": DelayedSlam(*parts, promotion=once, **tables),
        "inverse_depth": EkfSlam(world.motion, rays, count, correction="joint"),
    }


def nameless():
    camera = sensors.BearingOnly([[SIGMA**2]])
    scenario = Scenario(
        name="five without names",
        motion=motion.Increment(np.diag([0.005, 0.003]) ** 2),
        sensor=camera,
        landmarks=[[4.0, 5.0], [-3.0, 4.0], [-2.0, 0.5], [5.0, -1.0], [0.5, 8.0]],
        controls=np.tile([0.2, 0.08], (120, 1)),
    )
    filter = DelayedSlam(
        scenario.motion,
        camera,
        8,
        stored=StoredMeasurements(capacity=40),
        hypotheses=Hypotheses(capacity=40, decay=0.7),
        promotion=Promotion(persistence=6),
        associate=Nearest(0.99, 0.9999),
    )
    return scenario, filter


def clutter(log, key):
    """Two bearings of nothing a step, beside the others."""
    steps = log.scan.z.shape[0]
    false = jax.random.uniform(key, (steps, 2, 1), log.scan.z.dtype, -np.pi, np.pi)
    scan = log.scan
    scan = scan._replace(
        z=jnp.concatenate([scan.z, false], axis=1),
        tag=jnp.pad(scan.tag, [(0, 0), (0, 2)], constant_values=-1),
        valid=jnp.pad(scan.valid, [(0, 0), (0, 2)], constant_values=True),
    )
    return log._replace(scan=scan)


def scores(scenario, filter, runs, names=True, spoil=None):
    """Of each run: mean pose NEES, mean squares, waits (N,), found and false landmarks."""

    def one(i):
        key = jax.random.fold_in(jax.random.key(0), i)
        truth, log = jaxslam.simulate(scenario, key)
        if spoil is not None:
            log = spoil(log, jax.random.fold_in(key, 1))
        trace = jaxslam.run(filter, log, scenario.pose, scenario.pose_cov, key)
        estimate = trace.estimate
        error = truth.pose - estimate.pose
        error = jnp.concatenate([error[:, :2], wrap(error[:, 2:])], axis=1)
        nees, regular = jax.vmap(mahalanobis_squared)(error, estimate.pose_cov)
        alive, tag = estimate.alive[-1], estimate.tag[-1]
        off = estimate.points[-1][:, None] - truth.landmarks[None, :, :2]
        off = jnp.sqrt((off**2).sum(axis=2))
        if names:
            off = jnp.take_along_axis(off, jnp.maximum(tag, 0)[:, None], axis=1)
        off = off.min(axis=1)
        false = alive & (off > FALSE)
        true = alive & ~false
        wait = jnp.where(true, jnp.argmax(estimate.alive, axis=0), 0)
        return {
            "nees": nees.sum() / regular.sum(),
            "position": (error[:, :2] ** 2).sum(axis=1).mean(),
            "landmarks": jnp.where(true, off**2, 0.0).sum() / jnp.maximum(true.sum(), 1),
            "wait": wait.sum() / jnp.maximum(true.sum(), 1),
            "found": true.sum(),
            "false": false.sum(),
        }

    block = jax.jit(jax.vmap(one))
    blocks = [np.arange(i, i + BLOCK) for i in range(0, runs, BLOCK)]
    parts = [jax.device_get(block(which)) for which in blocks]
    return {name: np.concatenate([part[name] for part in parts])[:runs] for name in parts[0]}


def row(found):
    nees = found["nees"]
    return {
        "pose NEES": f"{nees.mean():.3g} ± {2 * nees.std() / len(nees) ** 0.5:.2g}",
        "median": np.median(nees),
        "position [m]": np.sqrt(found["position"].mean()),
        "landmarks [m]": np.sqrt(found["landmarks"].mean()),
        "wait": found["wait"].mean(),
        "found": found["found"].mean(),
        "false": found["false"].mean(),
    }


def measure(quick: bool = False) -> list[Metric]:
    runs = 20 if quick else 100
    scenario, filters = named()
    rows = {name: row(scores(scenario, filter, runs)) for name, filter in filters.items()}
    show(f"{scenario.name}, {len(scenario.landmarks)} columns: {runs} runs", rows)
    delayed = rows["delayed"]
    metrics = [
        Metric("delayed, cloister: median pose NEES", delayed["median"], high=6.0),
        Metric("delayed, cloister: false landmarks", delayed["false"], high=0.5),
    ]
    scenario, filter = nameless()
    count = len(scenario.landmarks)
    rows = {
        name: row(scores(scenario, filter, runs, names=False, spoil=spoil))
        for name, spoil in (("still", None), ("clutter", clutter))
    }
    show(f"{scenario.name}: {runs} runs × {scenario.steps} steps", rows)
    for name, found in rows.items():
        what = f"delayed, {name}: found of {count}"
        metrics += [
            Metric(what, found["found"], low=0.8 * count),
            Metric(f"delayed, {name}: false landmarks", found["false"], high=0.5),
        ]
    return metrics
