"""Logs drawn from the models, as data sets: what `twin` and `check_models` take."""

import dataclasses

import jax
import numpy as np

from jaxslam import Scenario, datasets, motion, sensors, simulate
from jaxslam.simulation.scenarios import BetweenRanges

DT = 0.2
POSTS = np.array([[3.0, 1.0], [1.0, 4.0], [-2.5, 2.5], [-2.0, -1.5], [1.5, -2.5], [5.0, 3.0]])


def yard(steps=60, model=motion.Unicycle, noise=(0.1, 0.05), **changed):
    """A robot that turns left and right among six posts, and sees those within 5 m."""
    turns = 0.6 * np.sign(np.sin(2 * np.pi * np.arange(steps) / 24 + 0.1))
    return Scenario(
        name="yard",
        motion=model(np.diag(noise) ** 2),
        sensor=sensors.RangeBearing(np.diag([0.05, 0.02]) ** 2, mount=(0.2, 0.0, 0.1)),
        landmarks=POSTS,
        controls=np.column_stack([np.full(steps, 0.5), turns, np.full(steps, DT)]),
        visible=BetweenRanges(0.0, 5.0),
        filter_options={"correction": "joint"},
        **changed,
    )


def dataset_of(world, log, **changed):
    """The data set of a log that was drawn from a world."""
    steps = world.steps
    fields = {
        "name": world.name,
        "log": jax.tree.map(np.asarray, log),
        "time": DT * np.arange(1.0, steps + 1),
        "motion": world.motion,
        "sensor": world.sensor,
        "tags": tuple("abcdefghij"[: len(world.landmarks)]),
        "pose": np.asarray(world.pose, float),
        "pose_cov": np.asarray(world.pose_cov, float),
        "filter_options": dict(world.filter_options),
    }
    return datasets.Dataset(**(fields | changed))


def drawn(world, seed=0, **changed):
    """The data set of a log that is drawn from a world."""
    _, log = simulate(world, jax.random.key(seed))
    return dataset_of(world, log, **changed)


def with_scan(data, **changed):
    """The data set with other scans."""
    log = data.log._replace(scan=data.log.scan._replace(**changed))
    return dataclasses.replace(data, log=log)
