"""Information: covariance and information of one filter, normalized; and SEIF, which cuts links."""

import jax
import numpy as np
from matplotlib.figure import Figure

import jaxslam
from jaxslam.filters import whole_information

jax.config.update("jax_enable_x64", True)
world = jaxslam.scenarios.circle(steps=240)
truth, log = jaxslam.simulate(world, jax.random.key(0))
start = world.pose, world.pose_cov, jax.random.key(0)
exact = jaxslam.filters.EifSlam(world.motion, world.sensor, 20)
sparse = jaxslam.filters.Seif(world.motion, world.sensor, 20, active=6, links=6)
dense = np.asarray(jaxslam.run(exact, log, *start).final.omega)
links = whole_information(jaxslam.run(sparse, log, *start).final).toarray()
shown = {
    "EIF: covariance": np.linalg.inv(dense),
    "EIF: information": dense,
    "SEIF: information": links,
}
figure = Figure(figsize=(7.2, 2.9), layout="constrained")
for axes, (name, matrix) in zip(figure.subplots(1, 3), shown.items(), strict=True):
    scale = np.sqrt(np.diagonal(matrix))
    shares = np.log10(np.maximum(np.abs(matrix) / np.outer(scale, scale), 1e-6))
    image = axes.imshow(shares, cmap="Blues", vmin=-6, vmax=0)
    axes.set(title=name, xlabel="entry of the state")
figure.colorbar(image, ax=figure.axes, shrink=0.75, label="log₁₀, normalized")
