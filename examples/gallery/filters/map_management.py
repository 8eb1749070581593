"""Map management: one false measurement a scan; landmarks not measured again are removed."""

import dataclasses

import jax

import jaxslam

jax.config.update("jax_enable_x64", True)
view = jaxslam.scenarios.BetweenRanges
clutter = jaxslam.spurious.Spurious(clutter=1.0, missed=0.05, reach=4.0)
world = jaxslam.scenarios.cloister(steps=100)
world = dataclasses.replace(world, visible=view(0.0, 4.0), places=36, spurious=clutter)
truth, log = jaxslam.simulate(world, jax.random.key(1))
near = jaxslam.association.Nearest(0.99, 0.9999)
ekf = jaxslam.filters.EkfSlam(world.motion, world.sensor, 140, correction="joint", associate=near)
pruned = dataclasses.replace(ekf, life=jaxslam.life.Existence(view(0.0, 3.2), patience=20))
start = world.pose, world.pose_cov, jax.random.key(0)
with_it, without = (jaxslam.run(filter, log, *start).estimate for filter in (pruned, ekf))
figure = jaxslam.plot.map_figure(
    with_it, truth=truth, others={"without a life": without}, title="life: EKF with clutter"
)
