"""Single precision over the long benchmark: the covariance stays positive definite, the pose close."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from worlds import draw, narrow

from jaxslam.filters import EkfSlam
from jaxslam.run import run
from jaxslam.simulation.scenarios import circle


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


def test_the_joint_covariance_is_positive_definite_at_every_step():
    """From the second step on: two noises cannot fill three dimensions of P0 = 0 in one."""
    for trace in traces():
        landmarks, everything = trace.probe
        assert landmarks.all()
        assert trace.estimate.pose_cov[0, 1, 1] == 0
        assert everything[1:].all(), f"first at step {1 + np.argmin(everything[1:])}"


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
