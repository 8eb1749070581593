"""compressed_ekf_slam: the numbers of ekf_slam, whatever the area and however often it is left."""

import dataclasses
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam import charts, linearize, sensors
from jaxslam.filters import compressed_ekf_slam, ekf_slam
from jaxslam.filters.ekf.compressed_ekf_slam import opened, up_to_date
from jaxslam.run import run
from jaxslam.simulation.scenarios import cloister
from jaxslam.simulation.worlds import simulate
from jaxslam.types import Scan, Status

KEY = jax.random.key(4)
CAPACITY = 24
ROOM = 16
"""slots fewer than the landmarks of the tour"""
STEPS, PLACES = 120, 6


@cache
def tour():
    """Half a cloister by a robot that sees 4 m: 20 landmarks or so, a few at a time."""
    near = dataclasses.replace(
        cloister(),
        visible=lambda pose, point: ((pose[:2] - point) ** 2).sum() < 16.0,
        places=PLACES,
    )
    near = dataclasses.replace(near, controls=np.asarray(near.controls)[:STEPS])
    draw = jax.jit(jax.vmap(partial(simulate, near)))
    return near, jax.device_get(draw(jax.random.split(KEY, 2)))[1]


@cache
def driver(area, capacity=ROOM, **options):
    """A jitted function of a log to its trace, by the ordinary filter where area is None."""
    world, _ = tour()
    if area is None:
        filter = ekf_slam(world.motion, world.sensor, capacity, **options)
    else:
        filter = compressed_ekf_slam(world.motion, world.sensor, capacity, area=area, **options)

    def probe(state):
        return state.slot if area else state

    def drive(log):
        return run(filter, log, world.pose, world.pose_cov, KEY, probe=probe)

    return drive


@cache
def driven(area, capacity=ROOM, **options):
    """The traces of both logs."""
    return jax.device_get(jax.jit(jax.vmap(driver(area, capacity, **options)))(tour()[1]))


def assert_same(a, b, rtol=1e-9):
    for left, right in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        scale = np.abs(np.asarray(left, np.float64)).max(initial=1e-12)
        np.testing.assert_allclose(left, right, rtol=0, atol=rtol * scale)


@pytest.mark.parametrize(
    ("area", "options"),
    [
        (PLACES, {}),
        (9, {"births": 1, "gate": 9.0, "iterations": 2}),
        (9, {"update": "joint", "covariance": "joseph", "linearize": "unscented"}),
    ],
)
def test_the_same_as_the_ordinary_filter(area, options):
    options = dict(options)
    if "linearize" in options:
        options["linearize"] = getattr(linearize, options["linearize"])()
    capacity = CAPACITY if options else ROOM
    plain, compressed = driven(None, capacity, **options), driven(area, capacity, **options)
    assert_same(plain.estimate, compressed.estimate)
    assert_same(plain.info, compressed.info, rtol=1e-7)  # a NIS divides by what noise is left
    whole = jax.jit(jax.vmap(up_to_date))(compressed.final)
    assert_same(plain.final, whole)
    chosen = np.asarray(compressed.probe)
    left = (np.diff(chosen, axis=1) != 0).any(axis=2).sum(axis=1)
    assert (left > 4).all()
    assert (np.asarray(plain.final.alive).sum(axis=1) > area).all()


def test_a_full_map_drops_what_the_ordinary_filter_drops():
    plain, compressed = driven(None), driven(PLACES)
    assert (np.asarray(plain.info.status) == Status.OVERFLOW).any()
    np.testing.assert_array_equal(plain.info.status, compressed.info.status)
    assert_same(plain.estimate, compressed.estimate)


def test_a_run_does_not_depend_on_the_runs_beside_it():
    batch = driven(PLACES)
    alone = jax.jit(driver(PLACES))(jax.tree.map(lambda x: x[0], tour()[1]))
    np.testing.assert_array_equal(batch.probe[0], alone.probe)
    assert_same(jax.tree.map(lambda x: x[0], batch.estimate), alone.estimate, rtol=1e-12)


def test_from_a_map_at_hand():
    world, logs = tour()
    rest = jax.tree.map(lambda x: x[0, STEPS - 20 :], logs)
    small = compressed_ekf_slam(world.motion, world.sensor, ROOM, area=PLACES)
    plain = jax.tree.map(lambda x: x[0], driven(None))
    joint = jax.tree.map(lambda x: x[STEPS - 21], plain.probe)

    @jax.jit
    def go_on(joint):
        def step(state, row):
            state = small.predict(state, row.control, KEY)
            return small.update(state, row.scan, KEY)

        return up_to_date(jax.lax.scan(step, opened(joint, PLACES), rest)[0])

    assert_same(plain.final, go_on(joint))


def test_gradients_pass_through_a_change_of_area():
    world, logs = tour()
    log = jax.tree.map(lambda x: x[0, :40], logs)

    def loss(sigma):
        sensor = sensors.range_bearing(jnp.diag(jnp.stack([sigma, 0.02])) ** 2)
        filter = compressed_ekf_slam(world.motion, sensor, CAPACITY, area=PLACES)
        trace = run(filter, log, world.pose, world.pose_cov, KEY, probe=lambda state: state.slot)
        points = (trace.estimate.points[-1] ** 2).sum()
        return points + trace.info.log_likelihood.sum(), trace.probe

    both = jax.jit(jax.value_and_grad(loss, has_aux=True))
    (_, chosen), slope = both(0.1)
    assert (np.diff(np.asarray(chosen), axis=0) != 0).any()
    rise = both(0.1 + 1e-5)[0][0] - both(0.1 - 1e-5)[0][0]
    np.testing.assert_allclose(slope, rise / 2e-5, rtol=1e-5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"area": 0}, "area"),
        ({"area": 4, "covariance": "square_root"}, "got 'square_root'"),
        ({"area": 4, "chart": charts.right_invariant()}, "right_invariant"),
        ({"area": 4, "linearize": linearize.first_estimate()}, "first_estimate"),
        ({"area": 4, "sensor": sensors.compass(np.eye(1))}, "a sensor of landmarks, got compass"),
        (
            {"area": PLACES - 1},
            f"area >= {PLACES}, the measurement slots of a scan, got {PLACES - 1}",
        ),
    ],
)
def test_refusals(options, message):
    world, logs = tour()
    options = {"sensor": world.sensor} | options
    sensor = options.pop("sensor")
    with pytest.raises(ValueError, match=message):
        filter = compressed_ekf_slam(world.motion, sensor, CAPACITY, **options)
        state = jax.eval_shape(filter.init, jnp.zeros(3), jnp.eye(3))
        jax.eval_shape(filter.update, state, jax.tree.map(lambda x: x[0, 0], logs).scan, KEY)


def test_an_empty_scan_and_one_landmark():
    world, _ = tour()
    filter = compressed_ekf_slam(world.motion, world.sensor, 1, area=1)
    state = jax.jit(filter.init)(np.zeros(3), np.eye(3))
    update, estimate = jax.jit(filter.update), jax.jit(filter.estimate)
    scan = Scan(np.array([[2.0, 0.1]]), np.array([7]), np.array([True]))
    born, info = update(state, scan, KEY)
    assert info.status[0] == Status.BORN
    after, info = update(born, jax.tree.map(lambda x: x[:0], scan), KEY)
    assert info.status.shape == (0,)
    assert_same(estimate(after), estimate(born))
