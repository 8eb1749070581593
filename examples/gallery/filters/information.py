"""Information: SEIF cuts weak links of the information matrix, and finds nearly the same map."""

import dataclasses

import jax

import jaxslam

jax.config.update("jax_enable_x64", True)
world = jaxslam.scenarios.circle(steps=240)
world = dataclasses.replace(world, filter_options={})
filters = {name: jaxslam.catalog.CANONICAL[name](world) for name in ("seif", "eif_slam")}
truth, log = jaxslam.simulate(world, jax.random.key(0))
start = world.pose, world.pose_cov, jax.random.key(0)
found = {name: jaxslam.run(filter, log, *start).estimate for name, filter in filters.items()}
others = {"eif_slam": found["eif_slam"]}
figure = jaxslam.plot.map_figure(found["seif"], truth=truth, others=others, title="circle: SEIF")
