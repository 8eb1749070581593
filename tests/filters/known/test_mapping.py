"""Mapping from known poses is EKF-SLAM of a robot that knows where it is."""

from functools import cache

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import refused, swept
from own_models import changed
from worlds import draw, nameless, ring

from jaxslam import association, charts, linearize, motion, run, sensors, simulate
from jaxslam.core.types import Status
from jaxslam.filters import EkfSlam, Mapping
from jaxslam.filters._known.mapping import as_prior
from jaxslam.math.stats import chi2_band

KEY = jax.random.key(0)


@cache
def world():
    scenario = ring(40)
    truth, log = draw(scenario, 5)
    return scenario, truth, log


def on_poses(filter, truth, log):
    start = np.zeros(3), np.zeros((3, 3)), KEY
    return jax.device_get(run(filter, log._replace(control=truth.pose), *start))


@pytest.mark.parametrize("options", swept([{}, {"gate": 0.9, "births": 1}], {}))
def test_it_is_slam_of_a_robot_that_knows_where_it_is(options):
    scenario, truth, log = world()
    capacity = 8
    # A motion without noise whose control is the pose: P_RR stays zero, and P block-diagonal.
    exact = changed(motion.PoseIncrement(np.zeros((3, 3))), step=lambda pose, u, w: u + 0 * w)
    slam = EkfSlam(exact, scenario.sensor, capacity, correction="joint", **options)
    expected = on_poses(slam, truth, log)
    trace = on_poses(Mapping(scenario.sensor, capacity, **options), truth, log)
    chex.assert_trees_all_close(trace.estimate, expected.estimate, rtol=1e-9, atol=1e-12)
    for name in ("status", "slot", "nis", "dof", "innovation_cov"):
        actual, wanted = getattr(trace.info, name), getattr(expected.info, name)
        np.testing.assert_allclose(actual, wanted, rtol=1e-8, atol=1e-10)
    np.testing.assert_array_equal(trace.estimate.pose_cov, 0)


@pytest.mark.sweep
def test_it_is_honest():
    """NEES of the landmarks over 200 worlds in the chi-square band of so many."""
    scenario, _, _ = world()
    filter = Mapping(scenario.sensor, 6)
    slam = EkfSlam(scenario.motion, scenario.sensor, 6)

    @jax.jit
    @jax.vmap
    def last(key):
        truth, log = simulate(scenario, key)
        start = jnp.zeros(3), jnp.zeros((3, 3)), KEY
        trace = run(filter, log._replace(control=truth.pose), *start)
        joint = as_prior(trace.final, slam, jnp.zeros(3), jnp.eye(3))
        off = truth.landmarks[trace.final.tag] - trace.final.landmarks
        return off.reshape(-1) @ jnp.linalg.solve(joint.cov[3:, 3:], off.reshape(-1))

    nees = np.asarray(last(jax.random.split(jax.random.key(9), 200)))
    low, high = chi2_band(12, 200, 0.999)
    assert low < nees.mean() < high


def test_a_prior_for_slam():
    """Filtered on from the map, and from the map's inverse variances by hand."""
    scenario, truth, log = world()
    final = on_poses(Mapping(scenario.sensor, 8), truth, log).final
    pose, cov = np.array([0.1, 0.2, 0.3]), np.diag([0.1, 0.2, 0.01])
    slam = EkfSlam(scenario.motion, scenario.sensor, 8)
    joint = jax.device_get(
        jax.jit(lambda *parts: as_prior(parts[0], slam, *parts[1:]))(final, pose, cov)
    )
    np.testing.assert_array_equal(joint.cov[:3, :3], cov)
    np.testing.assert_array_equal(joint.cov[:3, 3:], 0)
    blocks = np.asarray(joint.cov)[3:, 3:].reshape(8, 2, 8, 2)
    for i in range(8):
        for j in range(8):
            own = np.asarray(final.covs[i]) if final.alive[i] else np.eye(2)
            np.testing.assert_array_equal(blocks[i, :, j], own if i == j else 0)
    row = jax.tree.map(lambda leaf: leaf[0], log.scan)
    after, info = jax.jit(slam.update)(joint, row, KEY)
    assert (info.status == Status.FUSED).all()
    assert np.trace(after.cov) < np.trace(joint.cov)


@pytest.mark.sweep
def test_without_tags():
    scenario, truth, log = world()
    method = association.JointCompatibility(0.999, 0.99999)
    trace = on_poses(Mapping(scenario.sensor, 8, associate=method), truth, nameless(log))
    assert (trace.final.alive).sum() == 6
    np.testing.assert_array_equal(trace.info.slot, log.scan.tag)


def test_a_full_map_refuses():
    scenario, truth, log = world()
    trace = on_poses(Mapping(scenario.sensor, 1), truth, log)
    status = np.asarray(trace.info.status)
    assert (status[:, 1:] == Status.OVERFLOW).all() and (status[1:, 0] == Status.FUSED).all()
    assert trace.final.lost == 40 * 5


FINAL = Mapping(ring(3).sensor, 2)


def prior(pose=(0.0, 0.0, 0.0), **options):
    slam = EkfSlam(ring(3).motion, ring(3).sensor, **({"capacity": 2} | options))
    final = jax.eval_shape(FINAL.init, np.zeros(3), np.eye(3))
    return jax.eval_shape(lambda final: as_prior(final, slam, np.array(pose), np.eye(3)), final)


@refused(
    (lambda: Mapping(ring(3).sensor, 0), "Mapping: .*capacity"),
    (lambda: Mapping(ring(3).sensor, 3, gate=0.0), "Mapping: gate: expected a probability above 0"),
    (lambda: Mapping(sensors.Compass(np.eye(1)), 3), "absolute"),
    (lambda: prior((0.0, 0.0)), r"pose \(3,\)"),
    (lambda: prior(capacity=3), "a filter of 2 landmarks"),
    (lambda: prior(chart=charts.RightInvariant()), "Euclidean"),
    (lambda: prior(covariance="square_root"), "covariance"),
    (lambda: prior(linearize=linearize.FirstEstimate()), "Jacobians"),
)
def test_refusals(make):
    assert prior().cov.shape == (7, 7)
    make()
