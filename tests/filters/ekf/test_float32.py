"""Single precision over the long benchmark: the covariance stays positive definite, the pose close."""

import jax
import numpy as np
import pytest

from jaxslam.filters import ekf_slam
from jaxslam.math.linalg import is_positive_definite
from jaxslam.run import run
from jaxslam.simulation.scenarios import circle
from jaxslam.simulation.worlds import simulate


@pytest.fixture(scope="module")
def traces():
    """The EKF over 2500 steps of the circle in float32 and in float64, on the same log."""
    scenario = circle(2500)
    filter = ekf_slam(scenario.motion, scenario.sensor, 20, **scenario.filter_options)
    _, log = jax.device_get(jax.jit(lambda key: simulate(scenario, key))(jax.random.key(11)))
    single = jax.tree.map(lambda a: a.astype("f4") if a.dtype == float else a, log)
    # Rounding the log to float32 and back leaves one log for both.
    double = jax.tree.map(lambda a: a.astype("f8") if a.dtype == np.float32 else a, single)

    @jax.jit
    def go(log):
        return run(
            filter,
            log,
            scenario.pose,
            scenario.pose_cov,
            jax.random.key(0),
            probe=lambda s: (is_positive_definite(s.cov[3:, 3:]), is_positive_definite(s.cov)),
        )

    return jax.device_get(go(single)), jax.device_get(go(double))


def test_everything_is_float32(traces):
    single, _ = traces
    kinds = {a.dtype for a in jax.tree.leaves(single) if np.issubdtype(a.dtype, np.floating)}
    assert kinds == {np.dtype("f4")}


def test_the_joint_covariance_is_positive_definite_at_every_step(traces):
    """From the second step on: two noises cannot fill three dimensions of P0 = 0 in one."""
    for trace in traces:
        landmarks, everything = trace.probe
        assert landmarks.all()
        assert trace.estimate.pose_cov[0, 1, 1] == 0
        assert everything[1:].all(), f"first at step {1 + np.argmin(everything[1:])}"


def test_symmetric_to_rounding(traces):
    cov = traces[0].final.cov
    np.testing.assert_allclose(cov, cov.T, atol=4 * np.finfo("f4").eps * np.abs(cov).max())


def test_the_pose_agrees_with_float64_far_within_its_sigma(traces):
    single, double = traces
    assert single.estimate.alive[-1].all()
    np.testing.assert_array_equal(single.info.status, double.info.status)
    error = single.estimate.pose.astype(float) - double.estimate.pose
    error[:, 2] = np.angle(np.exp(1j * error[:, 2]))
    variance = np.einsum("tii->ti", double.estimate.pose_cov)[2:]  # zero in y before
    assert np.abs(error[2:] / np.sqrt(variance)).max() < 0.01
    ratio = np.einsum("tii->ti", single.estimate.pose_cov)[2:] / variance
    assert np.abs(ratio - 1).max() < 2e-3
