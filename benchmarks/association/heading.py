"""One scan, one decision: what each method makes of it as the heading becomes uncertain.

A mapped cluster of landmarks, a robot in the middle whose heading has a standard deviation of 0 to
45°, one scan of eight of them. An error of the heading moves all expected measurements together:
each alone may then be nearest to a wrong landmark, while all of them still fit together.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.association import rules
from jaxslam.core.slots import Joint
from jaxslam.core.types import Scan
from jaxslam.filters import EkfSlam
from jaxslam.filters._ekf.predicted_measurements import prediction_of
from jaxslam.math.angles import wrap
from jaxslam.math.linalg import root_psd
from jaxslam.motion import Increment
from jaxslam.results.plot import PAGE, caption, curve, panels_of, titled
from jaxslam.sensors import RangeBearing

COUNT, SEEN, DRAWS = 14, 8, 500
SIGMAS = np.array([0.5, 2, 4, 6, 8, 10, 12, 15, 20, 25, 30, 35, 40, 45])
SENSOR = RangeBearing(np.diag([0.1, np.deg2rad(1.0)]) ** 2)
METHODS = rules(0.99, budget=20_000, candidates=COUNT)


def decide(method, sigma, key):
    """Shares of a scan's measurements associated rightly and wrongly."""
    keys = jax.random.split(key, 4)
    angle = jax.random.uniform(keys[3], (COUNT,), minval=-jnp.pi, maxval=jnp.pi)
    radius = jax.random.uniform(keys[0], (COUNT,), minval=2.0, maxval=8.0)
    points = radius[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
    spread = jnp.concatenate([jnp.array([0.1, 0.1]), sigma[None], jnp.full(2 * COUNT, 0.05)])
    joint = Joint(
        pose=jnp.zeros(3),
        landmarks=points,
        cov=jnp.diag(spread**2),
        alive=jnp.ones(COUNT, bool),
        tag=jnp.full(COUNT, -1),
        lin=(),
    )
    error = spread * jax.random.normal(keys[1], spread.shape)
    pose = jnp.append(error[:2], wrap(error[2]))
    true = (points + error[3:].reshape(COUNT, 2))[:SEEN]
    exact = jax.vmap(SENSOR.observe, (None, 0))(pose, true)
    normals = jax.random.normal(keys[2], exact.shape)
    noise = jax.vmap(lambda z, n: root_psd(SENSOR.noise_cov(z)) @ n)(exact, normals)
    z = jax.vmap(SENSOR.residual)(exact + noise, jnp.zeros_like(exact))
    scan = Scan(z, jnp.full(SEEN, -1), jnp.ones(SEEN, bool))
    ekf = EkfSlam(Increment(np.eye(2)), SENSOR, COUNT)
    found = method(prediction_of(ekf, SENSOR, joint), scan)
    right = found.slot == jnp.arange(SEEN)
    return right.mean(), (~right & (found.slot >= 0)).mean()


def measure():
    """By method: (right, wrong), (S,) each over SIGMAS."""
    keys = jax.random.split(jax.random.key(0), DRAWS)
    out = {}
    for name, method in METHODS.items():
        over = jax.jit(jax.vmap(partial(decide, method), (None, 0)))
        each = [over(jnp.deg2rad(sigma), keys) for sigma in SIGMAS]
        out[name] = tuple(np.array([float(e[i].mean()) for e in each]) for i in range(2))
    return out


def draw(found):
    figure, panels = panels_of(PAGE, 2.6, 1, 2)
    for i, (name, (right, wrong)) in enumerate(found.items()):
        for axes, share in zip(panels, (right, wrong), strict=True):
            curve(axes, i, np.array(SIGMAS), 100 * share, name)
    for axes, what in zip(panels, ("rightly", "wrongly"), strict=True):
        axes.set(xlabel="standard deviation of the heading [°]", ylim=(0, None))
        titled(axes, f"measurements associated {what} [%]")
    panels[0].set(ylim=(0, 103))
    caption(figure, "")
    return figure
