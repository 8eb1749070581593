"""The fixed-lag smoother against the batch solution and the EKF of a linear world.

What it may not see: tests/consistency/test_catalog.py.
"""

import dataclasses
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds
from cases import refused
from test_smoothing import KEY, MARK, P0, START, F, arguments, linear_log, linear_world, regular

from jaxslam import motion, run, sensors, simulate
from jaxslam.core.types import Log, Scan, Status
from jaxslam.filters import EkfSlam
from jaxslam.graphs.smoothing import BatchMap, FixedLag


@pytest.fixture(scope="module")
def short():
    """Four steps, drawn by a program of tests/core."""
    ring = worlds.ring(steps=8)
    controls, start = ring.controls[:4], np.diag([0.01, 0.0, 0.003])
    world = dataclasses.replace(ring, controls=controls, pose_cov=start)
    return world, simulate(world, KEY)[1]


def lag(world, **options):
    count = len(world.landmarks)
    return FixedLag(world.motion, world.sensor, count, count, **options)


@pytest.mark.sweep
def test_a_window_as_long_as_the_log_is_the_batch(short):
    """With a noise that grows with the range, held at the predictions of each iterate."""
    grows = sensors.RangeBearing(sensors.RangeBearingNoise(0.03, 0.02, share=0.1))
    world = dataclasses.replace(short[0], sensor=grows)
    log = simulate(world, KEY)[1]
    filter = lag(world, window=4, iterations=12)
    trace = run(filter, log, world.pose, world.pose_cov, KEY)
    batch = BatchMap(*arguments(world))(log, KEY)
    for name in ("pose", "pose_cov", "points", "point_covs"):
        ours, theirs = (np.asarray(getattr(t.estimate, name))[-1] for t in (trace, batch))
        np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(trace.final.at.path[0], batch.final.start, atol=1e-8)


@pytest.mark.sweep
def test_a_window_without_finite_numbers_begins_anew_and_says_so(short):
    world, log = short
    world = dataclasses.replace(world, landmarks=world.landmarks[:2])
    filter = lag(world, window=1, iterations=1)
    scan = Scan(*(leaf[0, :2] for leaf in log.scan))
    begun = filter.init(jnp.asarray(world.pose), jnp.asarray(world.pose_cov))
    wild = begun._replace(at=jax.tree.map(lambda leaf: jnp.nan * leaf, begun.at))

    predict, update = jax.jit(filter.predict), jax.jit(filter.update)
    state = predict(begun, log.control[0], KEY)
    chex.assert_trees_all_close(predict(wild, log.control[0], KEY), state)
    after, info = update(state._replace(at=wild.at), scan, KEY)
    assert info.exhausted
    assert not update(state, scan, KEY)[1].exhausted
    chex.assert_tree_all_finite(after)


def test_in_a_linear_world_it_is_the_kalman_filter():
    """What leaves the window is marginalized without loss; landmarks enter at any time."""
    log = linear_log(steps=9)
    moves, sees = linear_world()
    used = log._replace(scan=log.scan._replace(valid=regular(log)))
    kalman = run(EkfSlam(moves, sees, 4, correction="joint"), used, START, P0, KEY)
    trace = run(FixedLag(moves, sees, 4, 4, window=3, iterations=1), log, START, P0, KEY)
    pairs = (jax.tree.leaves(each.estimate) for each in (trace, kalman))
    for ours, theirs in zip(*pairs, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(trace.final.joint.cov, kalman.final.cov, rtol=1e-8, atol=1e-10)
    exact = log.scan.valid & ~regular(log)
    assert exact.sum() == 1
    assert (np.asarray(trace.info.status)[exact] == Status.SINGULAR).all()


def test_a_noise_is_singular_by_the_prediction_of_a_landmark_and_the_measurement_of_a_new_one():
    """At the second step: a measurement that claims to be exact whose prediction does not, one that
    does not whose prediction does, and a new landmark that does."""
    start, tags = np.array(START), np.arange(3, dtype=np.int32)
    control, z = np.tile(start - F @ start, (9, 1)), np.zeros((9, 3, 2))
    control[1, 0] -= 0.2  # all are predicted farther by 0.2
    z[0, :, 0] = [MARK - 3.5, MARK - 0.1, 0.0]
    z[1, :, 0] = [MARK + 0.1, MARK - 0.2, MARK + 0.1]
    valid = np.zeros((9, 3), bool)
    valid[0, :2] = valid[1] = True
    log = Log(control, Scan(z, np.where(valid, tags, -1), valid))
    moves, sees = linear_world()
    trace = run(FixedLag(moves, sees, 4, 4, window=3, iterations=1), log, START, P0, KEY)
    expected = [Status.FUSED, Status.SINGULAR, Status.SINGULAR]
    np.testing.assert_array_equal(trace.info.status[1], expected)
    np.testing.assert_array_equal(trace.info.slot[1], [0, -1, -1])
    valid[1] = [True, False, False]
    used = log._replace(scan=log.scan._replace(valid=valid))
    kalman = run(EkfSlam(moves, sees, 4, correction="joint"), used, START, P0, KEY)
    pairs = (jax.tree.leaves(each.estimate) for each in (trace, kalman))
    for ours, theirs in zip(*pairs, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-8, atol=1e-10)


@pytest.mark.sweep
def test_float32_and_gradients(short):
    world, log = short
    world = dataclasses.replace(world, landmarks=world.landmarks[:2])
    few = Log(log.control[:3], Scan(*(leaf[:3, :2] for leaf in log.scan)))

    def last(sigma, log):
        made = dataclasses.replace(
            world,
            motion=motion.Increment(jnp.diag(sigma[:2]) ** 2),
            sensor=sensors.RangeBearing(sigma[2] ** 2 * jnp.eye(2)),
        )
        filter = lag(made, window=1, iterations=1, first_estimates=True)
        pose = run(filter, log, world.pose, np.zeros((3, 3)), KEY).estimate.pose[-1]
        return pose, pose

    sigma = np.array([0.01, 0.04, 0.05])
    slope, double = jax.jit(jax.jacfwd(partial(last, log=few), has_aux=True))(sigma)
    assert np.isfinite(slope).all()
    assert np.all(np.abs(slope).max(axis=0) > 0)
    single, _ = jax.jit(last)(*worlds.narrow((sigma, few)))
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, double, atol=2e-4)


@refused(
    ({"window": 0}, "window"),
    ({"iterations": 0}, "iterations"),
    ({"slots": 0}, "slots"),
    ({"sensor": sensors.BearingOnly(np.eye(1))}, "as many numbers"),
    ({"sensor": sensors.Compass(np.eye(1))}, "as many numbers"),
    (
        {"sensor": sensors.RangeBearingSignature(np.eye(3)), "first_estimates": True},
        r"landmarks \(x, y\)",
    ),
)
def test_what_does_not_fit_is_refused(options):
    fields = {"motion": worlds.ring().motion, "sensor": worlds.ring().sensor}
    fields |= {"capacity": 3, "slots": 3} | options
    FixedLag(**fields)


def test_a_scan_that_is_too_large_is_refused(short):
    world, log = short
    with pytest.raises(ValueError, match="slots: expected at least 6, as a scan has, got 2"):
        run(FixedLag(world.motion, world.sensor, 6, 2), log, world.pose, world.pose_cov, KEY)
