"""The whole pipeline, association, life and merging together, on logs that nobody would wish for."""

from functools import cache

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import swept

from jaxslam import association, life, motion, run, sensors
from jaxslam.core.types import Log, Scan, Status
from jaxslam.filters import EkfSlam, Merging

STEPS, PLACES = 400, 4
MOTION = motion.Increment(np.diag([0.01, 0.01]) ** 2)
SENSOR = sensors.RangeBearing(np.diag([0.05, 0.02]) ** 2)
GATE, NEW = 0.99, 0.9999
MAKERS = {
    "nearest": association.Nearest,
    "maximum_likelihood": association.MaximumLikelihood,
    "global_nearest": association.GlobalNearest,
    "joint": lambda _, new: association.JointCompatibility(0.99, new, budget=50),
}
METHODS = {name: (name, GATE, NEW) for name in MAKERS} | {
    "gates of 0 and 1": ("nearest", 0.0, 1.0),
    "gates of 1": ("nearest", 1.0, 1.0),
}
CASES = [(method, 6) for method in METHODS] + [("joint", 1)]
OF_NEAREST = [case for case in CASES if METHODS[case[0]][0] == "nearest"]


@cache
def program(capacity, name):
    """A run as a program of the log and the gates."""
    manager = life.Existence(
        lambda pose, point: ((point - pose[:2]) ** 2).sum() < 25, patience=5, replace=True
    )

    def one(log, *gates):
        associate = MAKERS[name](*gates)
        plain = EkfSlam(MOTION, SENSOR, capacity, associate=associate, life=manager)
        filter = Merging(plain, 0.3)
        return run(filter, log, jnp.zeros(3), jnp.zeros((3, 3)), jax.random.key(0))

    return jax.jit(one)


@cache
def go(method, capacity, world):
    name, *gates = METHODS[method]
    return jax.device_get(program(capacity, name)(WORLDS[world], *gates))


def log_of(z, valid):
    """Measurements (STEPS, PLACES, 2) without tags, of a robot that goes round in a circle."""
    z = np.broadcast_to(np.asarray(z, float), (STEPS, PLACES, 2))
    valid = np.broadcast_to(valid, (STEPS, PLACES))
    tag = np.full((STEPS, PLACES), -1, np.int32)
    return Log(np.tile([0.05, 0.05], (STEPS, 1)), Scan(z.copy(), tag, valid.copy()))


def seen_from_the_path(points, sigma=1.0):
    """What a robot without noise of its own measures of points (PLACES, 2)."""
    rng, pose, rows = np.random.default_rng(1), np.zeros(3), []
    for _ in range(STEPS):
        # Solà's increment: forward, then turn.
        pose = pose + [0.05 * np.cos(pose[2]), 0.05 * np.sin(pose[2]), 0.05]
        off = points - pose[:2]
        bearing = np.arctan2(off[:, 1], off[:, 0]) - pose[2]
        z = np.stack([np.hypot(*off.T), (bearing + np.pi) % (2 * np.pi) - np.pi], axis=1)
        rows.append(z + sigma * rng.normal(size=z.shape) * [0.05, 0.02])
    return np.array(rows)


def worlds():
    rng = np.random.default_rng(0)
    square = np.array([[3.0, 0], [0, 3], [-3, 0], [0, -3]])
    one_place = np.array([[3.0, 0.0]] * 2 + [[0.0, 3.0]] * 2)
    false = rng.uniform([0.5, -3], [5, 3], size=(STEPS, PLACES, 2))
    return {
        "nothing seen": log_of(np.zeros(2), False),
        "nothing but clutter": log_of(false, True),
        "four landmarks": log_of(seen_from_the_path(square), True),
        "two landmarks at one place": log_of(seen_from_the_path(one_place), True),
        "a landmark on the robot": log_of(np.zeros(2), True),
        "negative ranges": log_of(-seen_from_the_path(square), True),
    }


WORLDS = worlds()


@pytest.mark.parametrize(("method", "capacity"), swept(CASES, *OF_NEAREST))
def test_everything_stays_finite_and_nothing_is_lost_uncounted(method, capacity):
    for name, log in WORLDS.items():
        trace = go(method, capacity, name)
        chex.assert_tree_all_finite(trace)
        # Every measurement has a status; every landmark of the map was born, and every one that
        # left it was removed or merged.
        status = np.asarray(trace.info.status)
        np.testing.assert_array_equal(status != Status.EMPTY, log.scan.valid, err_msg=name)
        born = (status == Status.BORN).sum()
        extra = trace.info.extra
        left = extra["pruning"].removed.sum() + (extra["merging"].pair[:, 0] >= 0).sum()
        assert born - left == np.asarray(trace.final.alive).sum(), name
        cov = np.asarray(trace.final.cov)
        assert np.linalg.eigvalsh(cov).min() > -1e-12, name
        np.testing.assert_allclose(cov, cov.T, atol=1e-12, err_msg=name)


@pytest.mark.parametrize("method", swept(MAKERS, "nearest"))
def test_what_the_worlds_hold_is_found(method):
    clean = go(method, 6, "four landmarks")
    assert np.asarray(clean.final.alive).sum() == 4
    assert (np.asarray(clean.info.status)[1:] == Status.FUSED).mean() > 0.97
    nothing = go(method, 6, "nothing seen")
    assert not np.asarray(nothing.final.alive).any()
    assert (np.asarray(nothing.estimate.pose_cov)[-1, :2, :2].trace()) > 0


@pytest.mark.sweep
def test_clutter_alone_confirms_nothing_for_long():
    trace = go("joint", 6, "nothing but clutter")
    removed = trace.info.extra["pruning"].removed.sum()
    assert removed > 20  # it comes and goes …
    confirmed = np.asarray(trace.final.life.confirmed) & np.asarray(trace.final.alive)
    assert confirmed.sum() <= 2  # … and little of it is believed
