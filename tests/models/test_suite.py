"""Several sensors on one robot: what a suite does, against updates put together by hand."""

import dataclasses
from functools import cache

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import refused
from own_models import changed
from worlds import draw, narrow, ring

import jaxslam
from jaxslam import Scenario, charts, filters, linearize, motion, sensors
from jaxslam.core.types import Status
from jaxslam.filters import EkfSlam
from jaxslam.sensors import Part, Suite
from jaxslam.simulation.scenarios import BetweenRanges
from jaxslam.simulation.spurious import Spurious

EYES = sensors.RangeBearing(np.diag([0.05, 0.02]) ** 2, mount=(0.1, -0.05, 0.3))
LASER = sensors.RelativePosition(np.diag([0.04, 0.06]) ** 2, mount=(-0.2, 0.0, 3.0))
COMPASS = sensors.Compass([[0.03**2]])
FIX = sensors.PositionFix(np.diag([0.1, 0.1]) ** 2)


def of_all(compass):
    """Three kinds of sensors, and two places for other robots."""
    return Suite(
        (
            Part(EYES, 4, visible=BetweenRanges(0.0, 4.0)),
            Part(LASER, 6, interval=3, start=1),
            Part(compass, 1, interval=5),
            Part(EYES, 2, sees="robots"),
        )
    )


PLACES = 13


def world(steps=40, **changes):
    return dataclasses.replace(ring(steps), name="suite", sensor=of_all(COMPASS), **changes)


@cache
def drawn():
    return draw(world(), 0)


@cache
def estimated():
    """The same filter for all logs of the world, so that it is traced once."""
    scenario = world()
    return scenario, EkfSlam(scenario.motion, scenario.sensor, 6)


def driven(ekf, scenario, log):
    start = scenario.pose, scenario.pose_cov, jax.random.key(0)
    return jax.device_get(jaxslam.run(ekf, log, *start))


def go(log):
    scenario, ekf = estimated()
    return driven(ekf, scenario, log)


@cache
def scans():
    """(state, scan, what becomes of a landmark) where all three have measured: of new landmarks, and
    of landmarks that are known."""
    _, log = drawn()
    scan = jax.tree.map(lambda leaf: leaf[10], log.scan)
    assert (scan.valid[:4].any(), scan.valid[4:10].all(), scan.valid[10]) == (True,) * 3
    known = go(log).final
    empty = jax.tree.map(np.zeros_like, known)._replace(cov=np.eye(15) / 10)
    return (empty, scan, Status.BORN), (known, scan, Status.FUSED)


def places(scan, first, count, size=2):
    """Those of a sensor of such measurements."""
    own = jax.tree.map(lambda leaf: leaf[first : first + count], scan)
    return own._replace(z=own.z[:, :size])


@pytest.mark.sweep
def test_a_suite_of_one_is_the_sensor():
    scenario, _ = estimated()
    pair = [EkfSlam(scenario.motion, s, 6) for s in (EYES, Suite(((EYES, 4),)))]

    @jax.jit
    def both(state, scan):
        updates = [(each, *each.update(state, scan, jax.random.key(0))) for each in pair]
        return [(after, info, each.estimate(after)) for each, after, info in updates]

    for state, scan, status in scans():
        own = places(scan, 0, 4)
        a, b = both(state, own)
        np.testing.assert_array_equal(a[1].status, np.where(own.valid, status, Status.EMPTY))
        chex.assert_trees_all_close(a, b, rtol=0, atol=1e-12)


@pytest.mark.sweep
def test_sensors_in_turn_are_filters_in_turn():
    """Each part by hand: the state of one filter handed to another, of its own sensor. In the chart
    whose basis turns the map; the others have a simpler one."""
    scenario, chart = world(), charts.RightInvariant()
    whole = EkfSlam(scenario.motion, scenario.sensor, 6, chart=chart)
    eyes, laser = (EkfSlam(scenario.motion, s, 6, chart=chart) for s in (EYES, LASER))
    # A compass among landmarks by hand: a sensor of points that ignores them.
    blind = changed(
        COMPASS,
        landmark=EYES.landmark,
        observe=lambda pose, point: COMPASS.observe(pose, point[:0]),
        invert=lambda pose, z, s: jnp.zeros(2),
    )
    heading = EkfSlam(
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

    @jax.jit
    def both(state, scan):
        at_once, _ = whole.update(state, scan, jax.random.key(0))
        for one, *own in ((eyes, 0, 4), (laser, 4, 6), (heading, 10, 1, 1)):
            state, _ = one.update(state, places(scan, *own), jax.random.key(0))
        return at_once, state

    for state, scan, _ in scans():
        at_once, in_turn = both(state, scan)
        assert np.abs(at_once.cov - state.cov).max() > 1e-6
        chex.assert_trees_all_close(at_once, in_turn, rtol=0, atol=1e-12)


def test_a_world_has_each_sensor_at_its_rate_and_in_its_places():
    truth, log = drawn()
    steps = np.arange(40)
    z, tag, valid = log.scan
    assert z.shape == (40, PLACES, 2)
    np.testing.assert_array_equal(valid[:, 4:10].all(1), steps % 3 == 1)
    np.testing.assert_array_equal(valid[:, 4:10].any(1), steps % 3 == 1)
    np.testing.assert_array_equal(valid[:, 10], steps % 5 == 0)
    assert not valid[:, 11:].any()
    assert (tag[:, 10] == -1).all()
    near = np.linalg.norm(truth.landmarks[None] - truth.pose[:, None, :2], axis=2)
    in_view = (near < 4.0).sum(1)
    np.testing.assert_array_equal(valid[:, :4].sum(1), np.minimum(in_view, 4))
    np.testing.assert_array_equal(truth.missed, np.maximum(in_view - 4, 0))
    # A compass reads the heading, to its noise; rows are padded with zeros.
    off = z[::5, 10, 0] - truth.pose[::5, 2]
    assert np.abs(np.angle(np.exp(1j * off))).max() < 5 * 0.03
    np.testing.assert_array_equal(z[:, 10, 1], 0.0)


def test_info_is_of_all_places():
    _, log = drawn()
    info = go(log).info
    assert info.status.shape == (40, PLACES)
    assert info.innovation_cov.shape == (40, PLACES, 2, 2)
    fused = info.status == Status.FUSED
    assert set(info.dof[:, :10][fused[:, :10]]) == {2}
    assert set(info.dof[:, 10][fused[:, 10]]) == {1}
    assert (info.slot[:, 10] == -1).all()
    np.testing.assert_array_equal(info.innovation_cov[:, 10, 1], 0.0)
    np.testing.assert_array_equal(fused[:, 10], log.scan.valid[:, 10])


@pytest.mark.sweep
def test_campaigns_judge_a_suite():
    """An honest filter of all three, and one that believes its compass too much is found out."""
    scenario, honest = estimated()
    proud = EkfSlam(scenario.motion, of_all(sensors.Compass([[0.004**2]])), 6)
    tried = {"honest": honest, "proud": proud}
    options = {"block": 100, "devices": jax.devices()[:1]}
    campaign = jaxslam.monte_carlo(scenario, tried, 100, jax.random.key(1), **options)
    honest, proud = (campaign.filters[name].measures["nees_pose"] for name in tried)
    assert honest.low < 3.0 < honest.high or abs(honest.value - 3.0) < 0.3
    assert proud.low > 3.5


def test_more_sensors_know_more():
    _, log = drawn()
    only = log._replace(scan=log.scan._replace(valid=log.scan.valid & (np.arange(PLACES) < 4)))
    both, one = (go(each).estimate.pose_cov[-1] for each in (log, only))
    assert np.trace(both) < np.trace(one)


@pytest.mark.sweep
def test_gradients_reach_every_part():
    """Of one scan of a map that is known, by every number of every sensor."""
    scenario, _ = estimated()
    _, (state, scan, _) = scans()

    def loss(theta, state, scan):
        eyes = sensors.RangeBearing(jnp.diag(theta[:2]) ** 2, mount=theta[4:7])
        compass = sensors.Compass(theta[2:3, None] ** 2)
        laser = sensors.RelativePosition(jnp.eye(2) * theta[3] ** 2)
        both = Suite(((eyes, 4), (laser, 6), (compass, 1), Part(EYES, 2, sees="robots")))
        ekf = EkfSlam(scenario.motion, both, 6, correction="joint")
        return ekf.update(state, scan, jax.random.key(0))[1].log_likelihood

    theta = np.array([0.05, 0.02, 0.03, 0.05, 0.1, 0.0, 0.3])
    slope = jax.jit(jax.jacfwd(loss))(theta, state, scan)
    assert np.isfinite(slope).all()
    assert (np.asarray(slope) != 0).all()


def test_places_for_robots_are_left_alone():
    _, log = drawn()
    met = jax.tree.map(np.copy, log.scan)
    met.valid[:, 11:], met.tag[:, 11:] = True, [70, 71]
    a, b = go(log), go(log._replace(scan=met))
    np.testing.assert_array_equal(a.final.cov, b.final.cov)
    assert (b.info.status[:, 11:] == Status.UNMATCHED).all()


def test_a_scan_with_other_places_is_refused():
    _, log = drawn()
    short = log._replace(scan=jax.tree.map(lambda leaf: leaf[:, :10], log.scan))
    with pytest.raises(ValueError, match=f"expected {PLACES} measurement slots"):
        go(short)
    twice = log.scan._replace(tag=np.zeros_like(log.scan.tag))
    with pytest.raises(ValueError, match="a tag repeats"):
        go(log._replace(scan=twice))


def signature():
    return sensors.RangeBearingSignature(np.diag([0.1, 0.1, 0.1]) ** 2)


@refused(
    (lambda: Suite(()), "at least one sensor"),
    (lambda: Suite((EYES,)), "expected a Part or"),
    (lambda: Suite(((EYES, 0),)), "Part: places: expected an integer >= 1"),
    (lambda: Suite((Part(EYES, 1, interval=0),)), "Part: interval: expected an integer >= 1"),
    (lambda: Suite((Part(EYES, 1, start=-1),)), "Part: start: expected an integer >= 0"),
    (lambda: Suite((Part(EYES, 1, sees="birds"),)), 'Part: sees: expected "landmarks"'),
    (lambda: Suite(((COMPASS, 2),)), "places: expected 1 of the absolute sensor compass, got 2"),
    (lambda: Suite(((Suite(((EYES, 1),)), 1),)), "Part: sensor: expected one Sensor, got a Suite"),
    (lambda: Suite(((EYES, 1), (signature(), 1))), "expected sensors that share landmarks"),
    (lambda: world(places=3), "each Part has its own places"),
    (lambda: world(spurious=Spurious()), "each Part has its own places"),
    (
        lambda: EkfSlam(ring().motion, world().sensor, 6, linearize=linearize.Observability()),
        "needs a suite without absolute sensors, not .*: choose linearize.AtEstimate",
    ),
    (
        lambda: filters.CompressedEkfSlam(EkfSlam(ring().motion, world().sensor, 6), area=3),
        "a suite is not supported",
    ),
    (
        lambda: Suite(((EYES, 1),)).observe(jnp.zeros(3), jnp.zeros(2)),
        "a suite has no model of its own",
    ),
)
def test_bad_input(make):
    make()


@pytest.mark.sweep
def test_absolute_sensors_alone_in_both_precisions():
    """A compass and a position fix on a robot without a map."""
    scenario = Scenario(
        name="absolute",
        motion=motion.Increment(np.diag([0.01, 0.01]) ** 2),
        sensor=Suite(((COMPASS, 1), (FIX, 1))),
        landmarks=np.zeros((1, 0)),
        controls=np.tile([0.1, 0.05], (30, 1)),
    )
    truth, log = draw(scenario, 0)
    ekf = EkfSlam(scenario.motion, scenario.sensor, 1)
    trace = driven(ekf, scenario, log)
    assert (trace.info.status == Status.FUSED).all()
    assert np.abs(trace.estimate.pose - truth.pose).max() < 0.2
    single = driven(ekf, scenario, narrow(log))
    np.testing.assert_allclose(single.estimate.pose, trace.estimate.pose, atol=1e-4)
