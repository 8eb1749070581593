"""Particles: localization from anywhere in a known map; at step 10 another place fits better."""

import jax
import numpy as np
from matplotlib.figure import Figure

import jaxslam

jax.config.update("jax_enable_x64", True)
world = jaxslam.scenarios.loop(steps=80)
truth, log = jaxslam.simulate(world, jax.random.key(0))
sensor = jaxslam.sensors.RelativePosition(0.5**2 * np.eye(2))  # wider than the world's
filter = jaxslam.filters.ParticleLocalization(
    world.motion, sensor, truth.landmarks, 2000, box=[[-14, -6], [14, 26]], start="uniform"
)
start = world.pose, world.pose_cov, jax.random.key(1)
trace = jaxslam.run(filter, log, *start, probe=lambda state: state.pose)
figure = Figure(figsize=(7.2, 3.3), layout="constrained")
for axes, step in zip(figure.subplots(1, 3, sharex=True, sharey=True), (0, 9, 79), strict=True):
    axes.plot(*truth.landmarks.T, "x", color="0.4")
    axes.plot(*trace.probe[step, :, :2].T, ".", ms=3, color="tab:blue")
    axes.plot(*truth.pose[step, :2], "o", ms=9, mew=2, mfc="none", color="tab:orange")
    axes.set(title=f"step {step + 1}", xlabel="x [m]", aspect="equal")
