"""The chart `robocentric` is the filter of Castellanos et al. 2007."""

import jax
import numpy as np
from reference.robocentric import Robocentric

from jaxslam.catalog import FILTERS
from jaxslam.run import run
from jaxslam.simulation.scenarios import loop
from jaxslam.simulation.worlds import simulate


def test_a_run_is_that_of_the_plain_filter():
    world = loop(steps=60)
    _, log = simulate(world, jax.random.key(3))
    filter = FILTERS["robocentric"](world)
    trace = jax.jit(lambda log: run(filter, log, world.pose, world.pose_cov, jax.random.key(0)))(
        log
    )
    q = np.asarray(world.motion.noise_cov(np.zeros(3), np.array([0.25, 0.025, 1.0])))
    plain = Robocentric(
        np.array(world.pose), np.asarray(world.pose_cov), q, world.sensor.noise_cov(np.zeros(2))
    )
    fused = 0
    for t in range(60):
        there = np.asarray(log.scan.valid[t])
        tags = np.asarray(log.scan.tag[t])[there].tolist()
        fused += sum(tag in plain.tags for tag in tags)
        plain.step(np.asarray(log.control[t]), np.asarray(log.scan.z[t])[there], tags)
        pose = plain.pose()
        np.testing.assert_allclose(trace.estimate.pose[t][:2], pose[:2], atol=1e-7)
        np.testing.assert_allclose(
            np.exp(1j * trace.estimate.pose[t][2]), np.exp(1j * pose[2]), atol=1e-7
        )
        np.testing.assert_allclose(
            trace.estimate.pose_cov[t], plain.pose_cov(), rtol=1e-5, atol=1e-8
        )
    assert fused > 50
    tags = np.asarray(trace.estimate.tag[-1])
    for tag, point in plain.points().items():
        slot = int(np.flatnonzero(tags == tag)[0])
        np.testing.assert_allclose(trace.estimate.points[-1, slot], point, atol=1e-6)
