"""CompressedEkfSlam: the numbers of EkfSlam, whatever the area and however often it is left."""

import dataclasses
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import refused, swept
from worlds import draw

from jaxslam import charts, linearize, run, sensors
from jaxslam.core.types import Status
from jaxslam.filters import CompressedEkfSlam, EkfSlam
from jaxslam.filters._ekf.compressed_ekf_slam import open_area, up_to_date
from jaxslam.simulation.scenarios import cloister

KEY = jax.random.key(4)
CAPACITY = 16
"""fewer than the landmarks of the tour"""
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
    logs = [draw(near, seed)[1] for seed in range(2)]
    return near, jax.tree.map(lambda *leaves: np.stack(leaves), *logs)


GATED = {"births": 1, "gate": 0.99, "iterations": 2}
CASES = {
    "in turn": (PLACES, GATED),
    "at once": (
        9,
        {"correction": "joint", "covariance": "joseph", "linearize": linearize.Unscented()},
    ),
}


@cache
def drivers(case):
    """The ordinary filter and the compressed one, both as a program of two logs to their traces."""
    world, _ = tour()
    area, options = CASES[case]
    plain = EkfSlam(world.motion, world.sensor, CAPACITY, **options)
    compressed = CompressedEkfSlam(plain, area)

    def drive(filter, probe, log):
        trace = run(filter, log, world.pose, world.pose_cov, KEY, probe=probe)
        return trace, trace.final if filter is plain else up_to_date(trace.final)

    probes = (plain, lambda state: state), (compressed, lambda state: state.slot)
    return [jax.jit(jax.vmap(partial(drive, *which))) for which in probes]


@cache
def driven(case):
    return [jax.device_get(drive(tour()[1])) for drive in drivers(case)]


def assert_same(a, b, rtol=1e-9):
    for left, right in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        scale = np.abs(np.asarray(left, np.float64)).max(initial=1e-12)
        np.testing.assert_allclose(left, right, rtol=0, atol=rtol * scale)


@pytest.mark.parametrize("case", swept(CASES, "in turn"))
def test_the_same_as_the_ordinary_filter(case):
    """Also where the map is full."""
    (plain, joint), (compressed, whole) = driven(case)
    assert_same(plain.estimate, compressed.estimate)
    assert_same(plain.info, compressed.info, rtol=1e-7)  # a NIS divides by what noise is left
    assert_same(joint, whole)
    chosen = np.asarray(compressed.probe)
    assert ((np.diff(chosen, axis=1) != 0).any(axis=2).sum(axis=1) > 4).all()  # areas left
    assert (joint.alive.sum(axis=1) > CASES[case][0]).all()
    assert (plain.info.status == Status.OVERFLOW).any()


@pytest.mark.sweep
def test_a_run_does_not_depend_on_the_runs_beside_it():
    log = jax.tree.map(lambda leaf: leaf[::-1].copy(), tour()[1])
    log.scan.valid[0] = False  # beside it nothing is seen
    run_of, other = drivers("in turn")[1](log)[0], driven("in turn")[1][0]
    np.testing.assert_array_equal(run_of.probe[1], other.probe[0])
    beside, alone = (
        jax.tree.map(lambda x, i=i: x[i], t.estimate) for t, i in ((run_of, 1), (other, 0))
    )
    assert_same(beside, alone, rtol=1e-12)


@pytest.mark.sweep
def test_from_a_map_at_hand():
    world, logs = tour()
    rest = jax.tree.map(lambda x: x[0, STEPS - 20 :], logs)
    small = CompressedEkfSlam(EkfSlam(world.motion, world.sensor, CAPACITY, **GATED), PLACES)
    plain, final = jax.tree.map(lambda x: x[0], driven("in turn")[0])
    joint = jax.tree.map(lambda x: x[STEPS - 21], plain.probe)

    @jax.jit
    def go_on(joint):
        def step(state, row):
            state = small.predict(state, row.control, KEY)
            return small.update(state, row.scan, KEY)

        return up_to_date(jax.lax.scan(step, open_area(joint, PLACES), rest)[0])

    assert_same(final, go_on(joint))


@pytest.mark.sweep
def test_gradients_pass_through_a_change_of_area():
    world, logs = tour()
    log = jax.tree.map(lambda x: x[0, :40], logs)

    def loss(sigma):
        sensor = sensors.RangeBearing(jnp.diag(jnp.stack([sigma, 0.02])) ** 2)
        plain = EkfSlam(world.motion, sensor, CAPACITY, correction="joint")
        filter = CompressedEkfSlam(plain, PLACES)
        trace = run(filter, log, world.pose, world.pose_cov, KEY, probe=lambda state: state.slot)
        points = (trace.estimate.points[-1] ** 2).sum()
        return points + trace.info.log_likelihood.sum(), trace.probe

    both = jax.jit(jax.value_and_grad(loss, has_aux=True))
    (_, chosen), slope = both(0.1)
    assert (np.diff(np.asarray(chosen), axis=0) != 0).any()
    rise = both(0.1 + 1e-5)[0][0] - both(0.1 - 1e-5)[0][0]
    np.testing.assert_allclose(slope, rise / 2e-5, rtol=1e-5)


@refused(
    ({"area": 0}, "area"),
    ({"area": 4, "covariance": "square_root"}, 'the covariance "square_root" is not'),
    ({"area": 4, "chart": charts.RightInvariant()}, "right_invariant"),
    ({"area": 4, "linearize": linearize.FirstEstimate()}, "first_estimate"),
    (
        {"area": 4, "sensor": sensors.Compass(np.eye(1))},
        "the sensor compass, which has no landmarks",
    ),
    (
        {"area": PLACES - 1},
        f"area: expected at least {PLACES}, as a scan has slots, got {PLACES - 1}",
    ),
)
def test_refusals(options):
    world, logs = tour()
    options = {"sensor": world.sensor} | options
    sensor, area = options.pop("sensor"), options.pop("area")
    filter = CompressedEkfSlam(EkfSlam(world.motion, sensor, CAPACITY, **options), area)
    state = jax.eval_shape(filter.init, jnp.zeros(3), jnp.eye(3))
    jax.eval_shape(filter.update, state, jax.tree.map(lambda x: x[0, 0], logs).scan, KEY)
