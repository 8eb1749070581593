"""Localization is EKF-SLAM in a map without error, and dead reckoning is that without measurements."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import refused, swept
from worlds import draw, judged, nameless, narrow, ring

from jaxslam import association, charts, linearize, run, sensors, simulate
from jaxslam.core.types import Scan, Status
from jaxslam.filters import (
    DeadReckoning,
    EkfSlam,
    Localization,
    ParticleLocalization,
    StartingAt,
)
from jaxslam.sensors import Part, Suite

KEY = jax.random.key(0)
START, SPREAD = np.array([0.1, -0.05, 0.02]), np.diag([0.2, 0.1, 0.05]) ** 2
GATE, NEW = 0.999, 0.99999


@cache
def world():
    scenario = replace(ring(40), pose=START, pose_cov=SPREAD)
    return scenario, draw(scenario, 3)


def with_compass():
    """The world whose robot has a compass as well, and its log."""
    scenario, (truth, log) = world()
    angles = truth.pose[:, 2] + 0.1 * np.random.default_rng(4).normal(size=scenario.steps)
    z = np.stack([angles, 0 * angles], axis=1)[:, None]
    row = Scan(z, np.full((len(z), 1), -1, np.int32), np.ones((len(z), 1), bool))
    scan = Scan(*(np.concatenate(pair, axis=1) for pair in zip(log.scan, row, strict=True)))
    sensor = Suite(((scenario.sensor, 6), Part(sensors.Compass(np.array([[0.01]])), 1)))
    return replace(scenario, sensor=sensor), log._replace(scan=scan)


def here(**options):
    scenario, _ = world()
    return Localization(scenario.motion, scenario.sensor, scenario.landmarks, **options)


def driven(filter, log):
    return jax.device_get(run(filter, log, START, SPREAD, KEY))


def slam_in_a_known_map(scenario, log, chart_name, options):
    """Poses and covariances of EKF-SLAM from a state whose landmarks are known exactly."""
    chart = charts.REGISTRY[chart_name]()
    points = np.asarray(scenario.landmarks)
    count = len(points)
    filter = EkfSlam(scenario.motion, scenario.sensor, count, chart=chart, **options)

    joint = filter.init(jnp.asarray(START), jnp.asarray(SPREAD))
    rows = [jnp.eye(3)]
    if chart.basis is None:
        rows += [jnp.zeros((2, 3))] * count
    else:  # coordinates without error: cross dx + B dl = 0
        for point in points:
            basis = chart.basis(joint.pose, point)
            own = jnp.eye(2) if basis.landmark is None else basis.landmark
            rows.append(-jnp.linalg.solve(own, basis.cross))
    lift = jnp.concatenate(rows)
    known = joint._replace(
        landmarks=jnp.asarray(points),
        cov=lift @ joint.cov[:3, :3] @ lift.T,
        alive=jnp.ones(count, bool),
        tag=jnp.arange(count, dtype=jnp.int32),
    )
    return driven(StartingAt(filter, known), log).estimate


@pytest.mark.parametrize(
    ("chart", "options", "compass"),
    swept(
        [
            ("euclidean", {"iterations": 3, "covariance": "joseph", "gate": 0.9}, False),
            ("euclidean", {}, True),
            ("right_invariant", {}, False),
            ("left_invariant", {"correction": "joint"}, False),
        ],
        ("euclidean", {}, True),
    ),
)
def test_it_is_slam_in_a_map_without_error(chart, options, compass):
    """With a compass beside the landmarks, too."""
    scenario, log = with_compass() if compass else (world()[0], world()[1][1])
    expected = slam_in_a_known_map(scenario, log, chart, options)
    options = options | {"chart": charts.REGISTRY[chart]()}
    filter = Localization(scenario.motion, scenario.sensor, scenario.landmarks, **options)
    trace = driven(filter, log)
    np.testing.assert_allclose(trace.estimate.pose, expected.pose, atol=1e-9)
    np.testing.assert_allclose(trace.estimate.pose_cov, expected.pose_cov, rtol=1e-7, atol=1e-12)
    assert not compass or (trace.info.status == Status.FUSED).all()


@pytest.mark.parametrize("method", swept(["nearest", "joint"], "nearest"))
def test_it_finds_its_landmarks_without_tags(method):
    scenario, (_, log) = world()
    make = {"nearest": association.Nearest, "joint": association.JointCompatibility}[method]
    trace = driven(here(associate=make(GATE, NEW)), nameless(log))
    fused = np.asarray(trace.info.status == Status.FUSED)
    assert fused.mean() > 0.98
    right = np.asarray(trace.info.slot) == np.asarray(log.scan.tag)
    assert right[fused].all()


def test_what_is_not_in_the_map_is_counted_and_not_started():
    scenario, (_, log) = world()
    part = Localization(
        scenario.motion, scenario.sensor, np.asarray(scenario.landmarks)[:4], tags=[5, 1, 2, 3]
    )
    trace = driven(part, log)
    status = np.asarray(trace.info.status)
    np.testing.assert_array_equal(status[:, [0, 4]], Status.UNMATCHED)
    np.testing.assert_array_equal(status[:, [1, 2, 3]], Status.FUSED)
    np.testing.assert_array_equal(trace.final.tag, [5, 1, 2, 3])


@pytest.mark.sweep
def test_sigma_points_are_close_to_jacobians():
    _, (_, log) = world()
    plain, sigma = (driven(here(**o), log) for o in ({}, {"linearize": linearize.Unscented()}))
    np.testing.assert_allclose(sigma.estimate.pose, plain.estimate.pose, atol=0.02)
    assert not np.array_equal(sigma.estimate.pose, plain.estimate.pose)


@pytest.mark.sweep
def test_it_is_honest_and_dead_reckoning_is_what_it_says():
    """The pose NEES of 200 runs in its interval, with a start that is not known either."""
    scenario, _ = world()
    filters = here(correction="joint"), DeadReckoning(scenario.motion, scenario.sensor)

    @jax.jit
    @jax.vmap
    def both(key):
        truth, log = simulate(scenario, key)
        return truth, [run(filter, log, START, SPREAD, KEY) for filter in filters]

    truth, traces = jax.device_get(both(jax.random.split(jax.random.key(7), 200)))
    found, lost = (judged(truth, trace.estimate, trace.info) for trace in traces)
    for each in (found, lost):
        assert each["nees_pose"][1] < 3 < each["nees_pose"][2]
    assert found["error_position"][2] < 0.5 * lost["error_position"][1]
    assert (traces[1].info.status == Status.UNMATCHED).all()


def test_dead_reckoning_is_the_motion_alone():
    scenario, (_, log) = world()
    trace = driven(DeadReckoning(scenario.motion, scenario.sensor), log)
    pose, move = START, jax.jit(scenario.motion.step)
    for u, estimate in zip(log.control, trace.estimate.pose, strict=True):
        pose = move(pose, u, np.zeros(2))
        np.testing.assert_allclose(estimate, pose, atol=1e-12)
    assert not trace.estimate.alive.any()


def test_a_map_of_fewer_landmarks_than_the_log_has_is_refused():
    """By row numbers; one with tags is of some landmarks, and without tags any map will do."""
    scenario, (_, log) = world()
    parts = scenario.motion, scenario.sensor, np.asarray(scenario.landmarks)[:4]
    for filter in (
        Localization(*parts),
        StartingAt(Localization(*parts), None),
        ParticleLocalization(*parts, 5),
    ):
        with pytest.raises(ValueError, match=r"^run: .* landmark 5, the map of .* has 4, 0 to 3; "):
            run(filter, log, START, SPREAD, KEY)
    for options in ({"tags": range(4)}, {"associate": association.Nearest(GATE)}):
        filter = Localization(*parts, **options)
        jax.eval_shape(lambda key, filter=filter: run(filter, log, START, SPREAD, key), KEY)


@pytest.mark.sweep
def test_gradient_and_float32():
    scenario, (_, log) = world()
    short = jax.tree.map(lambda leaf: leaf[:5], log)

    def last(landmarks):
        filter = Localization(scenario.motion, scenario.sensor, landmarks)
        trace = run(filter, short, START, SPREAD, KEY)
        return (trace.estimate.pose[-1] ** 2).sum()

    slope = jax.jit(jax.grad(last))(np.asarray(scenario.landmarks))
    assert np.isfinite(slope).all() and (slope != 0).all()
    trace = run(here(), *narrow((log, START, SPREAD)), KEY)
    assert trace.estimate.pose.dtype == trace.final.cov.dtype == jnp.float32
    np.testing.assert_allclose(trace.estimate.pose, driven(here(), log).estimate.pose, atol=1e-3)


@refused(
    ({"landmarks": np.zeros((3, 3))}, r"landmarks: expected shape \(at least 1, 2\)"),
    ({"landmarks": np.zeros((0, 2))}, "at least 1"),
    ({"landmarks": np.full((2, 2), np.nan)}, "landmarks: expected finite numbers"),
    ({"tags": [0, 0, 1, 2, 3, 4]}, "6 different ones"),
    ({"tags": [-1, 0, 1, 2, 3, 4]}, "6 different ones"),
    ({"linearize": linearize.FirstEstimate()}, "is for estimated maps"),
    ({"linearize": linearize.Unscented(), "iterations": 2}, "does not iterate"),
    ({"correction": "whole"}, "sequential"),
)
def test_refusals(options):
    scenario, _ = world()
    Localization(scenario.motion, scenario.sensor, **({"landmarks": scenario.landmarks} | options))
