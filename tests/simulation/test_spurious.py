"""Spurious data: it is what it says, the truth knows of it, and associations are scored by it."""

import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds
from cases import refused, swept

from jaxslam import association, life, monte_carlo, run, sensors, simulate
from jaxslam.consistency._measures.associations import association_scores, identities
from jaxslam.core.types import Estimate, Info, Scan, Status, Trace
from jaxslam.filters import EkfSlam
from jaxslam.simulation.spurious import Spurious

SENSOR = sensors.RangeBearing(np.diag([0.1, 0.02]) ** 2)
M, RUNS = 12, 4000


@cache
def spoilt():
    """Many scans of twelve landmarks on a circle, with everything going wrong at known rates."""
    around = 2 * np.pi * np.arange(M) / M
    points = 3 * np.stack([np.cos(around), np.sin(around)], axis=1)
    z = jax.jit(jax.vmap(SENSOR.observe, (None, 0)))(np.zeros(3), points)
    scan = Scan(jnp.asarray(z), jnp.arange(M, dtype=jnp.int32), jnp.arange(M) < 10)
    wrong = Spurious(clutter=1.5, missed=0.2, outliers=0.1, mislabelled=0.25, reach=5.0)
    keys = jax.random.split(jax.random.key(0), RUNS)
    many = jax.jit(jax.vmap(lambda key: wrong.spoil(SENSOR, jnp.zeros(3), scan, key)))
    return scan, jax.device_get(many(keys))


def test_rates_are_those_asked_for():
    scan, (got, origin) = spoilt()
    n = RUNS * 10
    there = got.valid[:, :10].mean()
    assert abs(there - 0.8) < 4 * np.sqrt(0.16 / n)
    false = (origin[:, :10] < 0) & got.valid[:, :10]
    assert abs(false.sum() / got.valid[:, :10].sum() - 0.1) < 4 * np.sqrt(0.09 / (0.8 * n))
    swapped = (got.tag[:, :10] != np.arange(10)) & got.valid[:, :10]
    assert abs(swapped.sum() / got.valid[:, :10].sum() - 0.25) < 0.04  # one alone keeps its tag
    clutter = got.valid[:, M:].sum(axis=1)
    assert got.valid.shape[1] == M + 3
    assert abs(clutter.mean() - 1.5) < 4 * np.sqrt(0.75 / RUNS)
    assert not got.valid[:, 10:M].any()


def test_a_scan_stays_well_formed_and_its_origin_is_true():
    scan, (got, origin) = spoilt()
    np.testing.assert_array_equal(got.tag[~got.valid], -1)
    assert not got.z[~got.valid].any()
    np.testing.assert_array_equal(got.tag[:, M:], -1)
    np.testing.assert_array_equal(origin[:, M:], -1)
    for tags, valid in zip(got.tag[:, :M], got.valid[:, :M], strict=True):
        assert len(set(tags[valid])) == valid.sum()
    true = origin[:, :M] >= 0
    place = np.broadcast_to(np.arange(M), true.shape)
    np.testing.assert_array_equal(origin[:, :M][true], place[true])
    np.testing.assert_array_equal(got.z[:, :M][true], np.broadcast_to(scan.z, (RUNS, M, 2))[true])


def test_false_measurements_are_of_points_within_reach():
    _, (got, origin) = spoilt()
    false = got.valid & (origin < 0)
    z = got.z[false]
    points = z[:, :1] * np.stack([np.cos(z[:, 1]), np.sin(z[:, 1])], axis=1)
    assert np.abs(points).max() < 5.5
    assert np.abs(points.mean(axis=0)).max() < 0.1
    np.testing.assert_allclose(points.std(axis=0), 5 / np.sqrt(3), rtol=0.05)


def test_nothing_wrong_leaves_the_scan_alone():
    world = dataclasses.replace(worlds.ring(steps=5), spurious=Spurious())
    truth, log = worlds.draw(world)
    np.testing.assert_array_equal(truth.origin, log.scan.tag)
    assert log.scan.valid.all()


@refused(
    ({"missed": 1.5}, "missed"),
    ({"mislabelled": -0.1}, "mislabelled"),
    ({"clutter": -1.0, "reach": 1.0}, "clutter"),
    ({"clutter": 1.0}, "reach"),
    ({"outliers": 0.1}, "reach"),
    ({"reach": np.nan}, "reach"),
    ({"clutter": 1.0, "reach": np.inf}, "reach"),
)
def test_refusals(options):
    Spurious(**options)


def test_associations_are_counted_by_what_a_slot_was_born_of():
    """Three steps, two slots: landmark 4 is born, then matched rightly, then wrongly; slot 1 is
    born of clutter, and then again of landmark 4."""
    born, fused, left = Status.BORN, Status.FUSED, Status.UNMATCHED
    status = np.array([[born, born], [fused, left], [fused, fused]])
    slot = np.array([[0, 1], [0, -1], [0, 1]])
    origin = np.array([[4, -1], [4, 4], [7, 4]])
    info = Info(0, 0, 0, 0, slot, status, 0)
    alive = np.ones((3, 2), bool)
    estimate = Estimate(np.zeros((3, 3)), 0, 0, 0, alive, np.zeros((3, 2), int))
    trace = Trace(estimate, info, None, None)
    held = jax.jit(identities)(trace, origin)
    np.testing.assert_array_equal(held, [[4, -1]] * 3)
    found = jax.jit(association_scores)(trace, origin, held)
    assert [float(x) for x in found["precision"]] == [1, 3]
    assert [float(x) for x in found["recall"]] == [1, 3]
    assert float(found["false_landmarks"][0]) == 1


METHODS = {
    "nearest": association.Nearest(0.9997, 1 - 1e-8),
    "maximum_likelihood": association.MaximumLikelihood(0.9997, 1 - 1e-8),
    "global_nearest": association.GlobalNearest(0.9997, 1 - 1e-8),
    "joint": association.JointCompatibility(0.999, 1 - 1e-8),
}


@pytest.fixture(scope="module")
def ruined():
    wrong = Spurious(clutter=1.0, missed=0.1, outliers=0.05, mislabelled=0.2, reach=4.0)
    world = dataclasses.replace(worlds.ring(steps=30), spurious=wrong)
    parts = world.motion, world.sensor, 20
    manager = life.Existence(lambda pose, landmark: jnp.asarray(True))
    filters = {
        "trusting": EkfSlam(*parts),
        "careful": EkfSlam(*parts, associate=METHODS["nearest"], life=manager),
    }
    options = {"block": 6, "devices": jax.devices()[:1]}
    return monte_carlo(world, filters, 6, jax.random.key(0), **options).filters


@pytest.mark.parametrize("name", swept(METHODS, "nearest"))
def test_where_landmarks_are_far_apart_every_method_finds_them_without_tags(name):
    """In four runs."""
    world = dataclasses.replace(worlds.ring(steps=12), spurious=Spurious())
    ekf = worlds.ekf(world, associate=METHODS[name])

    def one(key):
        truth, log = simulate(world, key)
        trace = run(ekf, log, world.pose, world.pose_cov, key)
        held = identities(trace, truth.origin)
        own = truth.landmarks[jnp.maximum(held[-1], 0)]
        error = jnp.where(trace.estimate.alive[-1, :, None], trace.estimate.points[-1] - own, 0.0)
        return association_scores(trace, truth.origin, held), error

    found, error = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), 4))
    share = {name: total.sum() / weight.sum() for name, (total, weight) in found.items()}
    assert share["precision"] == 1.0
    assert share["recall"] > 0.99
    assert share["false_landmarks"] == 0
    assert np.sqrt((error**2).sum(axis=2).mean()) < 0.2


@pytest.mark.sweep
def test_filters_with_and_without_a_life_share_a_campaign(ruined):
    """Their results differ in what no score reads: the programs that score them must not mix."""
    assert [summary.counts["runs"] for summary in ruined.values()] == [6, 6]


@pytest.mark.sweep
def test_wrong_labels_ruin_a_filter_that_believes_them_and_no_other(ruined):
    bad, good = (ruined[name].measures for name in ("trusting", "careful"))
    assert bad["precision"].low < 0.9
    assert good["precision"].value > 0.9
    assert bad["nees_pose"].low > 30
    assert good["nees_pose"].low < 5
    assert ruined["careful"].counts["unmatched"] > 0
