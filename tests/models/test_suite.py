"""Several sensors on one robot: what a suite does, against updates put together by hand."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from worlds import draw, ring

import jaxslam
from jaxslam import charts, filters, linearize, motion, sensors
from jaxslam.filters import ekf_slam
from jaxslam.sensors import Part, suite
from jaxslam.simulation.scenarios import between_ranges
from jaxslam.simulation.spurious import Spurious
from jaxslam.simulation.worlds import Scenario
from jaxslam.types import Status

EYES = sensors.range_bearing(np.diag([0.05, 0.02]) ** 2, mount=(0.1, -0.05, 0.3))
LASER = sensors.relative_position(np.diag([0.04, 0.06]) ** 2, mount=(-0.2, 0.0, 3.0))
COMPASS = sensors.compass([[0.03**2]])
FIX = sensors.position_fix(np.diag([0.1, 0.1]) ** 2)


def world(steps=40, **changes):
    both = suite(
        Part(EYES, 4, visible=between_ranges(0.0, 4.0)),
        Part(LASER, 6, every=3, start=1),
        Part(COMPASS, 1, every=5),
    )
    return dataclasses.replace(ring(steps), name="suite", sensor=both, **changes)


def drawn(scenario, seed=0):
    return draw(scenario, seed)


def go(scenario, log, **options):
    ekf = ekf_slam(scenario.motion, scenario.sensor, len(scenario.landmarks), **options)
    start = scenario.pose, scenario.pose_cov, jax.random.key(0)
    return jax.device_get(jaxslam.run(ekf, log, *start))


def test_a_suite_of_one_is_the_sensor():
    alone = ring(60)
    one = dataclasses.replace(alone, sensor=suite((alone.sensor, 6)))
    log = drawn(alone)[1]
    a, b = go(alone, log), go(one, log)
    for left, right in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(left, right, rtol=0, atol=1e-12)


@pytest.mark.parametrize("chart", [charts.euclidean(), charts.right_invariant()])
def test_sensors_in_turn_are_filters_in_turn(chart):
    """Each part by hand: the state of one filter handed to another, of its own sensor."""
    scenario = world()
    _, log = drawn(scenario)
    trace = go(scenario, log, chart=chart)
    whole = ekf_slam(scenario.motion, scenario.sensor, 6, chart=chart)
    eyes, laser = (ekf_slam(scenario.motion, s, 6, chart=chart) for s in (EYES, LASER))
    # A compass among landmarks by hand: a sensor of points that ignores them.
    blind = dataclasses.replace(
        COMPASS,
        landmark=EYES.landmark,
        observe=lambda pose, point: COMPASS.observe(pose, point[:0]),
        invert=lambda pose, z, s: jnp.zeros(2),
    )
    heading = ekf_slam(
        scenario.motion,
        blind,
        6,
        chart=chart,
        associate=lambda prediction, scan: (
            jnp.where(scan.valid, 0, -1).astype(jnp.int32),
            jnp.zeros_like(scan.valid),
            False,
        ),
    )

    def by_hand(log):
        def step(state, row):
            control, scan = row
            state = eyes.predict(state, control, jax.random.key(0))
            at = 0
            for one, places, size in ((eyes, 4, 2), (laser, 6, 2), (heading, 1, 1)):
                own = jax.tree.map(lambda leaf, a=at, n=places: leaf[a : a + n], scan)
                state, _ = one.update(state, own._replace(z=own.z[:, :size]), jax.random.key(0))
                at += places
            return state, state

        start = whole.init(jnp.asarray(scenario.pose), jnp.asarray(scenario.pose_cov))
        return jax.lax.scan(step, start, log)[0]

    state = jax.jit(by_hand)(jax.tree.map(jnp.asarray, log))
    np.testing.assert_allclose(trace.final.pose, state.pose, rtol=0, atol=1e-12)
    np.testing.assert_allclose(trace.final.landmarks, state.landmarks, rtol=0, atol=1e-12)
    np.testing.assert_allclose(trace.final.cov, state.cov, rtol=0, atol=1e-12)


def test_a_world_has_each_sensor_at_its_rate_and_in_its_places():
    scenario = world()
    truth, log = drawn(scenario)
    steps = np.arange(40)
    valid, tag = np.asarray(log.scan.valid), np.asarray(log.scan.tag)
    assert log.scan.z.shape == (40, 11, 2)
    np.testing.assert_array_equal(valid[:, 4:10].all(1), steps % 3 == 1)
    np.testing.assert_array_equal(valid[:, 4:10].any(1), steps % 3 == 1)
    np.testing.assert_array_equal(valid[:, 10], steps % 5 == 0)
    assert (tag[:, 10] == -1).all()
    near = np.linalg.norm(
        np.asarray(truth.landmarks)[None] - np.asarray(truth.pose)[:, None, :2], axis=2
    )
    in_view = (near < 4.0).sum(1)
    np.testing.assert_array_equal(valid[:, :4].sum(1), np.minimum(in_view, 4))
    np.testing.assert_array_equal(truth.missed, np.maximum(in_view - 4, 0))
    # A compass reads the heading, to its noise; rows are padded with zeros.
    off = np.asarray(log.scan.z)[::5, 10, 0] - np.asarray(truth.pose)[::5, 2]
    assert np.abs(np.angle(np.exp(1j * off))).max() < 5 * 0.03
    np.testing.assert_array_equal(np.asarray(log.scan.z)[:, 10, 1], 0.0)


def test_info_is_of_all_places():
    scenario = world()
    _, log = drawn(scenario)
    info = go(scenario, log).info
    assert info.status.shape == (40, 11)
    assert info.innovation_cov.shape == (40, 11, 2, 2)
    fused = np.asarray(info.status) == Status.FUSED
    dof = np.asarray(info.dof)
    assert set(dof[:, :10][fused[:, :10]]) == {2}
    assert set(dof[:, 10][fused[:, 10]]) == {1}
    assert (np.asarray(info.slot)[:, 10] == -1).all()
    np.testing.assert_array_equal(np.asarray(info.innovation_cov)[:, 10, 1], 0.0)
    np.testing.assert_array_equal(fused[:, 10], np.asarray(log.scan.valid)[:, 10])


def test_campaigns_judge_a_suite():
    """An honest filter of all three, and one that believes its compass too much is found out."""
    scenario = world(steps=40)
    proud = sensors.compass([[0.004**2]])
    wrong = suite(*scenario.sensor.parts[:2], (proud, 1))
    campaign = jaxslam.monte_carlo(
        scenario,
        {
            "honest": ekf_slam(scenario.motion, scenario.sensor, 6),
            "proud": ekf_slam(scenario.motion, wrong, 6),
        },
        100,
        jax.random.key(1),
    )
    honest, proud = (campaign.filters[name].measures["nees_pose"] for name in ("honest", "proud"))
    assert honest.low < 3.0 < honest.high or abs(honest.value - 3.0) < 0.3
    assert proud.low > 3.5


def test_more_sensors_know_more():
    scenario = world(steps=40)
    _, log = drawn(scenario)
    only = log._replace(scan=log.scan._replace(valid=log.scan.valid & (np.arange(11) < 4)))
    both, one = (go(scenario, each).estimate.pose_cov[-1] for each in (log, only))
    assert np.trace(both) < np.trace(one)


def test_gradients_reach_every_part():
    scenario = world(steps=4)
    _, log = drawn(scenario)

    def loss(theta):
        eyes = sensors.range_bearing(jnp.diag(theta[:2]) ** 2, mount=theta[4:7])
        compass = sensors.compass(theta[2:3, None] ** 2)
        laser = sensors.relative_position(jnp.eye(2) * theta[3] ** 2)
        both = suite((eyes, 4), (laser, 6), (compass, 1))
        ekf = ekf_slam(scenario.motion, both, 6)
        trace = jaxslam.run(ekf, log, scenario.pose, scenario.pose_cov, jax.random.key(0))
        return trace.info.log_likelihood.sum()

    slope = jax.jit(jax.grad(loss))(jnp.array([0.05, 0.02, 0.03, 0.05, 0.1, 0.0, 0.3]))
    assert np.isfinite(slope).all()
    assert (np.asarray(slope) != 0).all()


def test_float32():
    scenario = world()
    _, log = drawn(scenario)
    single = jax.tree.map(
        lambda x: x.astype(jnp.float32) if jnp.issubdtype(x.dtype, jnp.floating) else x, log
    )
    a, b = go(scenario, log), go(scenario, single)
    assert b.final.cov.dtype == jnp.float32
    np.testing.assert_allclose(a.estimate.pose, b.estimate.pose, atol=1e-4)


def test_places_for_robots_are_left_alone():
    scenario = world(steps=3)
    parts = (*scenario.sensor.parts, Part(EYES, 2, sees="robots"))
    scenario = dataclasses.replace(scenario, sensor=suite(*parts))
    _, log = drawn(scenario)
    assert not np.asarray(log.scan.valid)[:, 11:].any()
    met = jax.tree.map(np.copy, log.scan)
    met.valid[:, 11:], met.tag[:, 11:] = True, [70, 71]
    a, b = go(scenario, log), go(scenario, log._replace(scan=met))
    np.testing.assert_array_equal(a.final.cov, b.final.cov)
    assert (np.asarray(b.info.status)[:, 11:] == Status.UNMATCHED).all()


def test_a_scan_with_other_places_is_refused():
    scenario = world()
    _, log = drawn(scenario)
    short = log._replace(scan=jax.tree.map(lambda leaf: leaf[:, :10], log.scan))
    with pytest.raises(ValueError, match="expected 11 measurement slots"):
        go(scenario, short)
    twice = log.scan._replace(tag=jnp.zeros_like(log.scan.tag))
    ekf = ekf_slam(scenario.motion, scenario.sensor, 6)
    with pytest.raises(ValueError, match="a tag repeats"):
        jaxslam.run(
            ekf, log._replace(scan=twice), (0.0, 0.0, 0.0), np.zeros((3, 3)), jax.random.key(0)
        )


def signature():
    return sensors.range_bearing_signature(np.diag([0.1, 0.1, 0.1]) ** 2)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: suite(), "at least one sensor"),
        (lambda: suite(EYES), "expected a Part or"),
        (lambda: suite((EYES, 0)), "places of range_bearing"),
        (lambda: suite(Part(EYES, 1, every=0)), "every of range_bearing"),
        (lambda: suite(Part(EYES, 1, start=-1)), "a start of at least 0"),
        (lambda: suite(Part(EYES, 1, sees="birds")), 'sees "landmarks"'),
        (lambda: suite((COMPASS, 2)), "expected places=1 of the absolute sensor compass, got 2"),
        (lambda: suite((suite((EYES, 1)), 1)), "expected one Sensor in each Part"),
        (lambda: suite((EYES, 1), (signature(), 1)), "expected sensors that share landmarks"),
        (lambda: world(places=3), "each Part has its own places"),
        (lambda: world(spurious=Spurious()), "each Part has its own places"),
        (
            lambda: ekf_slam(ring().motion, world().sensor, 6, linearize=linearize.observability()),
            "does not support absolute sensors",
        ),
        (
            lambda: filters.compressed_ekf_slam(ring().motion, world().sensor, 6, area=3),
            "not a suite",
        ),
        (
            lambda: suite((EYES, 1)).observe(jnp.zeros(3), jnp.zeros(2)),
            "a suite has no model of its own",
        ),
    ],
)
def test_bad_input(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_absolute_sensors_alone():
    """A compass and a position fix on a robot without a map."""
    both = suite((COMPASS, 1), (FIX, 1))
    scenario = Scenario(
        name="absolute",
        motion=motion.increment(np.diag([0.01, 0.01]) ** 2),
        sensor=both,
        landmarks=np.zeros((1, 0)),
        controls=np.tile([0.1, 0.05], (30, 1)),
    )
    truth, log = drawn(scenario)
    trace = go(scenario, log)
    assert (np.asarray(trace.info.status) == Status.FUSED).all()
    assert np.abs(trace.estimate.pose - truth.pose).max() < 0.2
