"""Whole runs: the gradient by every parameter and of every kind of filter; single precision."""

import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds
from worlds import draw, narrow

from jaxslam import charts, linearize, motion, run, sensors, simulate
from jaxslam.core.slots import Joint
from jaxslam.core.types import Status
from jaxslam.filters import EkfSlam
from jaxslam.filters._ekf.correction import correct_in_turn
from jaxslam.math.stats import sigma_gate
from jaxslam.simulation.scenarios import circle, cloister

KEY = jax.random.key(0)
WHEELBASE, SPEED, DT = 0.5, 1.0, 0.1
PARAMETERS = {
    "speed noise [m/s]": 0.1,
    "steering noise [rad]": 0.09,
    "range noise [m]": 0.1,
    "bearing noise [rad]": np.deg2rad(1.0),
    "mount x [m]": 0.05,
    "mount y [m]": -0.03,
    "mount turn [rad]": 0.02,
    "wheelbase [m]": WHEELBASE,
}
AT = np.array(list(PARAMETERS.values()))


def models(p):
    """A small car without offsets, and a mounted sensor, from the parameters."""
    car = motion.Ackermann(jnp.diag(p[:2]) ** 2, wheelbase=p[7], sensor=(0.0, 0.0), encoder=0.0)
    return car, sensors.RangeBearing(jnp.diag(p[2:4]) ** 2, mount=p[4:7])


def world():
    """The cloister, its circle of 0.1 m and 0.05 rad a step driven by the car, its own noise on it."""
    car, sensor = models(AT)
    steering = np.arctan(0.05 * WHEELBASE / (SPEED * DT))
    controls = np.tile([SPEED, steering, DT], (200, 1))
    return dataclasses.replace(cloister(), motion=car, sensor=sensor, controls=controls)


def log_likelihood(p, log, *, capacity=36, gate=None):
    """Σ over the run, and the statuses; births as the scenario has them.

    No gate by default: the likelihood jumps where a measurement crosses it, and has no derivative
    there that differences could agree with.
    """
    car, sensor = models(p)
    filter = EkfSlam(car, sensor, capacity, births=1, gate=gate)
    start = cloister()
    info = run(filter, log, start.pose, start.pose_cov, KEY).info
    return info.log_likelihood.sum(), info.status


@pytest.fixture(scope="module")
def log():
    return jax.device_get(jax.jit(lambda key: simulate(world(), key))(jax.random.key(4)))[1]


@pytest.fixture(scope="module")
def compiled(log):
    """Value, statuses and gradient."""
    return jax.jit(jax.value_and_grad(log_likelihood, has_aux=True)).lower(AT, log).compile()


@pytest.fixture(scope="module")
def gradient(compiled, log):
    return np.asarray(compiled(AT, log)[1])


@pytest.mark.sweep
def test_the_gradient_of_200_steps_is_that_of_central_differences(log, compiled, gradient):
    value = jax.jit(lambda p: log_likelihood(p, log)[0])
    (total, status), _ = compiled(AT, log)
    counts = np.bincount(np.asarray(status).ravel(), minlength=len(Status))
    assert counts[Status.BORN] == 36  # one a step, then all of them are fused
    assert counts[Status.FUSED] == 200 * 36 - counts[Status.DEFERRED] - 36
    assert float(total) == pytest.approx(float(value(AT)), rel=1e-12)
    assert np.isfinite(gradient).all()
    for i, name in enumerate(PARAMETERS):
        # Fourth order, so that a step wide enough for rounding is narrow enough for curvature.
        step = 3e-4 * max(abs(AT[i]), 0.1) * np.eye(len(AT))[i]
        ends = [float(value(AT + k * step)) for k in (-2, -1, 1, 2)]
        numeric = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * step[i])
        assert abs(gradient[i] - numeric) < 1e-5 * max(abs(numeric), 1.0), name
        assert abs(gradient[i]) > 1.0, name  # every parameter is reached


@pytest.mark.sweep
def test_reverse_mode_keeps_one_state_a_step(compiled):
    state = 8 * (3 + 2 * 36) ** 2
    assert compiled.memory_analysis().temp_size_in_bytes < 1.5 * 200 * state


@pytest.fixture(scope="module")
def gated():
    """In float32, with the 3 σ gate and a map six landmarks too small."""
    return jax.jit(
        jax.value_and_grad(
            lambda p, log: log_likelihood(p, log, capacity=30, gate=sigma_gate(3, 2)), has_aux=True
        )
    )


@pytest.mark.sweep
@pytest.mark.parametrize("case", ["full scans", "every third scan empty", "no measurement at all"])
def test_gradients_are_finite_in_float32_with_gate_overflow_and_empty_scans(gated, log, case):
    """Also with P0 = 0, which is where the cloister starts."""
    valid = np.array(log.scan.valid)
    if case == "every third scan empty":
        valid[::3] = False
    elif case == "no measurement at all":
        valid[:] = False
    single = worlds.narrow(log)
    single = single._replace(scan=single.scan._replace(valid=valid))
    (total, status), slope = gated(AT.astype("f4"), single)
    assert slope.dtype == np.float32
    assert np.isfinite(total)
    assert np.isfinite(slope).all()
    counts = np.bincount(np.asarray(status).ravel(), minlength=len(Status))
    if case == "no measurement at all":
        assert counts[Status.EMPTY] == status.size
        assert not np.asarray(slope).any()
    else:
        assert all(counts[[Status.FUSED, Status.BORN, Status.REJECTED, Status.OVERFLOW]])


FORMS = {
    "sigma points": {"chart": charts.RightInvariant(), "linearize": linearize.Unscented()},
    "square root": {"covariance": "square_root"},
}


@pytest.mark.sweep
@pytest.mark.parametrize("name", FORMS)
def test_in_reverse_through_a_motion_and_corrections_in_turn(name):
    """By both noises, from a pose that is known exactly. Corrected at once, and with births:
    tests/consistency/test_catalog.py."""
    points, slot = np.array([[2.0, 1.0], [1.0, -2.0]]), np.array([0, 1, 0])
    root = np.diag([0.0, 0, 0, 0.1, 0.2, 0.1, 0.3])
    cov = root if name == "square root" else root @ root
    joint = Joint(np.array([0.1, 0.2, 0.3]), points, cov, np.ones(2, bool), np.arange(2), ())
    z = np.array([[1.9, 0.1], [2.2, -1.5], [1.8, 0.12]])

    def cost(sigma, joint):
        sensor = sensors.RangeBearing(jnp.diag(sigma[2:]) ** 2)
        robot = motion.Increment(jnp.diag(sigma[:2]) ** 2)
        ekf = EkfSlam(robot, sensor, 2, **FORMS[name])
        joint = ekf.predict(joint, jnp.array([0.2, 0.1]), jax.random.key(0))
        joint, done = correct_in_turn(ekf, sensor, joint, z, slot, np.ones(3, bool), None)
        return done.log_likelihood.sum() + joint.pose.sum() + (joint.cov**2).sum()

    at = np.array([0.01, 0.04, 0.05, 0.02])
    both = jax.jit(jax.value_and_grad(cost))
    slope = np.asarray(both(at, joint)[1])
    steps = 1e-3 * np.diag(at)  # sigma points round at 1e-8
    rise = [
        (both(at + step, joint)[0] - both(at - step, joint)[0]) / (2 * step.sum()) for step in steps
    ]
    np.testing.assert_allclose(slope, rise, rtol=5e-5, atol=1e-3)
    assert np.all(slope != 0)


# --- Single precision over the long benchmark: the covariance stays positive definite, the pose c--


@cache
def traces():
    """The EKF over 2500 steps of the circle in float32 and in float64, on the same log."""
    scenario = circle(2500)
    filter = EkfSlam(scenario.motion, scenario.sensor, 20, **scenario.filter_options)
    single = narrow(draw(scenario, 11)[1])
    # Rounding the log to float32 and back leaves one log for both.
    double = jax.tree.map(lambda a: a.astype("f8") if a.dtype == np.float32 else a, single)

    def definite(state):
        return [jnp.isfinite(jnp.linalg.cholesky(p)).all() for p in (state.cov[3:, 3:], state.cov)]

    start = scenario.pose, scenario.pose_cov, jax.random.key(0)
    return [jax.device_get(run(filter, log, *start, probe=definite)) for log in (single, double)]


@pytest.mark.sweep
def test_the_joint_covariance_is_positive_definite_at_every_step():
    """From the second step on: two noises cannot fill three dimensions of P0 = 0 in one."""
    for trace in traces():
        landmarks, everything = trace.probe
        assert landmarks.all()
        assert trace.estimate.pose_cov[0, 1, 1] == 0
        assert everything[1:].all(), f"first at step {1 + np.argmin(everything[1:])}"


@pytest.mark.sweep
def test_everything_is_float32_and_agrees_with_float64_far_within_its_sigma():
    single, double = traces()
    kinds = {a.dtype for a in jax.tree.leaves(single) if np.issubdtype(a.dtype, np.floating)}
    assert kinds == {np.dtype("f4")}
    cov = single.final.cov
    np.testing.assert_allclose(cov, cov.T, atol=4 * np.finfo("f4").eps * np.abs(cov).max())
    assert single.estimate.alive[-1].all()
    np.testing.assert_array_equal(single.info.status, double.info.status)
    error = single.estimate.pose.astype(float) - double.estimate.pose
    error[:, 2] = np.angle(np.exp(1j * error[:, 2]))
    variance = np.einsum("tii->ti", double.estimate.pose_cov)[2:]  # zero in y before
    assert np.abs(error[2:] / np.sqrt(variance)).max() < 0.01
    ratio = np.einsum("tii->ti", single.estimate.pose_cov)[2:] / variance
    assert np.abs(ratio - 1).max() < 2e-3
