"""What association and the observability monitor see of a filter: predictions, the linear system."""

import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds
from cases import refused, swept

from jaxslam import catalog, charts, filters, life, linearize, run, sensors
from jaxslam.core.record import record
from jaxslam.core.slots import Joint
from jaxslam.core.types import Scan
from jaxslam.filters import Closing, EkfSlam, Filter, Monitored, Wrapper
from jaxslam.filters._ekf import correction, predicted_measurements
from jaxslam.linearize import FirstEstimate

SENSOR = sensors.RangeBearing(np.diag([0.1, 0.02]) ** 2, mount=(0.2, -0.1, 0.4))
COUNT = 4
OBSERVE = jax.jit(jax.vmap(SENSOR.observe, (None, 0)))
RESIDUAL = jax.jit(jax.vmap(SENSOR.residual, (None, 0)))


def some_joint(seed=0):
    rng = np.random.default_rng(seed)
    root = 0.1 * rng.normal(size=(3 + 2 * COUNT, 3 + 2 * COUNT))
    return Joint(
        pose=np.array([1.0, -0.5, 3.0]),
        landmarks=4 * rng.normal(size=(COUNT, 2)),
        cov=root @ root.T,
        alive=np.array([True, True, False, True]),
        tag=np.array([4, 5, -1, 7]),
        lin=(),
    )


def some_scan(joint, seed=1):
    rng = np.random.default_rng(seed)
    z = np.asarray(OBSERVE(joint.pose, joint.landmarks))[[3, 0, 1]]
    noise = rng.normal(size=(3, 2)) * np.array([0.1, 0.02])
    return Scan(z + noise, np.array([7, 4, 5]), np.array([True, True, False]))


@cache
def dense(name):
    """Joint -> (N·Z, D): the derivative of all expected measurements by the error in a chart."""
    chart = charts.REGISTRY[name]()

    def expected(xi, joint):
        over = jax.vmap(chart.retract, in_axes=(None, 0, None, 0))
        poses, landmarks = over(joint.pose, joint.landmarks, xi[:3], xi[3:].reshape(-1, 2))
        return jax.vmap(SENSOR.observe)(poses, landmarks).ravel()

    return jax.jit(lambda joint: jax.jacfwd(expected)(jnp.zeros(3 + 2 * COUNT), joint))


@pytest.mark.parametrize(
    ("name", "square_root"),
    swept(
        [("euclidean", True), ("right_invariant", False), ("left_invariant", True)],
        ("right_invariant", False),
    ),
)
def test_pairs_and_cross_covariances_are_those_of_dense_algebra(name, square_root):
    chart, joint = charts.REGISTRY[name](), some_joint()
    scan = some_scan(joint)
    held = joint._replace(cov=np.linalg.cholesky(joint.cov)) if square_root else joint
    covariance = "square_root" if square_root else "plain"
    ekf = EkfSlam(WORLD.motion, SENSOR, COUNT, chart=chart, covariance=covariance)

    @jax.jit
    def look(held, scan):
        prediction = predicted_measurements.prediction_of(ekf, SENSOR, held)
        return prediction.pairs(scan), prediction.cross()

    pairs, cross = jax.device_get(look(held, scan))
    h = np.asarray(dense(name)(joint))
    products = (h @ joint.cov @ h.T).reshape(COUNT, 2, COUNT, 2)
    np.testing.assert_allclose(cross, products, atol=1e-12)
    observed = OBSERVE(joint.pose, joint.landmarks)
    for i in range(3):
        noise = np.asarray(SENSOR.noise_cov(scan.z[i]))
        for j, nu in enumerate(np.asarray(RESIDUAL(scan.z[i], observed))):
            cov = products[j, :, j] + noise
            np.testing.assert_allclose(pairs.innovation[i, j], nu, atol=1e-12)
            np.testing.assert_allclose(pairs.cov[i, j], cov, atol=1e-12)
            np.testing.assert_allclose(pairs.distance[i, j], nu @ np.linalg.solve(cov, nu))
            np.testing.assert_allclose(pairs.log_det[i, j], np.linalg.slogdet(cov)[1])
            assert bool(pairs.possible[i, j]) == bool(scan.valid[i] and joint.alive[j])


def test_a_scan_judged_for_association_is_judged_alike_in_the_correction():
    joint = some_joint()
    scan = some_scan(joint)
    ekf = EkfSlam(WORLD.motion, SENSOR, COUNT, linearize=linearize.Unscented())
    slot, measurement = np.array([3, 0, 1]), np.arange(3)

    @jax.jit
    def judged(joint, scan):
        pairs = predicted_measurements.prediction_of(ekf, SENSOR, joint).pairs(scan)
        return pairs, correction.correct(ekf, SENSOR, joint, scan.z, slot, scan.valid, None)[1]

    pairs, done = jax.device_get(judged(joint, scan))
    np.testing.assert_allclose(pairs.innovation[measurement, slot], done.innovation, atol=1e-12)
    np.testing.assert_allclose(pairs.cov[measurement, slot], done.innovation_cov, atol=1e-12)


# --- The observability monitor as a wrapper: of what it is refused, and of maps that are managed --


WORLD = worlds.ring(steps=40)
FEJ = catalog.variant(WORLD, linearize=FirstEstimate(), correction="joint")


def managed(rule):
    """The filter with a rule for the life of its landmarks."""
    return dataclasses.replace(FEJ, life=rule)


@record
class Wrapped(Wrapper):
    """A filter as it is, whose steps return no linear system."""

    filter: Filter


@record
class Corrected(EkfSlam):
    """One with an update of its own."""

    def update(self, state, scan, key):
        return super().update(state, scan, key)


@pytest.mark.sweep
def test_landmarks_that_leave_the_map_and_come_back_tell_nothing_of_a_turn():
    """First estimates keep the turn unobservable; a slot begins anew with each landmark."""
    filter = Monitored(managed(life.Existence(lambda pose, point: point[0] < 100.0)))
    _, log = worlds.draw(WORLD)
    valid = log.scan.valid & (np.arange(40) // 5 % 3 == 0)[:, None]
    log = log._replace(scan=log.scan._replace(valid=valid))
    trace = run(filter, log, WORLD.pose, WORLD.pose_cov, jax.random.key(0))
    removed = np.asarray(trace.info.extra["pruning"].removed)
    assert (np.diff(np.asarray(trace.estimate.alive).astype(int), axis=0) > 0)[5:].any()
    assert removed.sum() > 5
    state, monitor = trace.final
    assert state.life is not None
    turn = monitor.turn
    assert float(turn @ monitor.information @ turn) < 1e-12 * float(monitor.scale.max())
    assert float(monitor.scale.min()) > 1.0


@refused(
    (filters.DeadReckoning(WORLD.motion, WORLD.sensor), "dead_reckoning do not return"),
    (filters.EifSlam(WORLD.motion, WORLD.sensor, 4), "eif_slam do not return"),
    (Wrapped(FEJ), "wrapped ekf_slam do not return"),
    (Corrected(WORLD.motion, WORLD.sensor, 4), "corrected do not return"),
    (filters.EkfSlam, "filter: expected a Filter, got the class EkfSlam: call it"),
    told="^Monitored: .*",
)
def test_a_filter_without_a_linear_system_is_refused(filter):
    Monitored(filter)


def test_a_map_is_managed_inside_the_monitor():
    outside = Closing(Monitored(managed(life.Recency())))
    with pytest.raises(
        ValueError,
        match=r"^Closing: filter: expected one whose state is a slots.Joint, .* got monitored ekf_slam",
    ):
        jax.eval_shape(outside.init, jnp.zeros(3), jnp.eye(3))
