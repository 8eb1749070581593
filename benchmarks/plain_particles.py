"""A plain particle filter over path and map against FastSLAM.

Williams's reason for Rao-Blackwellization: the number of particles that a posterior needs grows
exponentially with its dimension, 3 + 2N for the joint state (x, y, θ, l_1 … l_N). What is measured
here is less: at a fixed number of particles the error grows with N. How the number needed grows is
not measured. FastSLAM samples the pose alone and keeps each landmark as a Gaussian given the path.
Same draws, same number of particles, a robot on a circle inside N landmarks that it always sees.
"""

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.gate import Metric, show
from jaxslam import filters, motion, run, sensors
from jaxslam.math import gaussians, linalg
from jaxslam.resampling import systematic
from jaxslam.simulation.worlds import Scenario, simulate

MOTION = motion.Increment(np.diag([0.01, 0.01]) ** 2)
SENSOR = sensors.RangeBearing(np.diag([0.1, 0.03]) ** 2)
LANDMARKS = (1, 2, 5, 10, 20)
STEPS = 100
PARTICLES = 500


def world(count: int) -> Scenario:
    around = 2 * np.pi * np.arange(count) / count
    return Scenario(
        name=f"{count} landmarks",
        motion=MOTION,
        sensor=SENSOR,
        landmarks=np.stack([4 * np.cos(around), 1.5 + 4 * np.sin(around)], axis=1),
        controls=np.tile([0.1, 2 * np.pi / STEPS], (STEPS, 1)),
    )


def plain(log, key, count: int):
    """Bootstrap filter of pose and map: the map (N, 2) at the end, and the mean ESS over the steps.

    The landmarks of the first scan are drawn from what it says; all are seen in every scan.
    """

    def place(z, noise):
        """A landmark seen from the origin."""
        z = z + linalg.root_psd(SENSOR.noise_cov(z)) @ noise
        return z[0] * jnp.array([jnp.cos(z[1]), jnp.sin(z[1])])

    def density(pose, landmark, z):
        nu = SENSOR.residual(z, SENSOR.observe(pose, landmark))
        return -0.5 * gaussians.mahalanobis_squared(nu, SENSOR.noise_cov(z))[0]

    def moved(pose, u, noise):
        return MOTION.step(pose, u, linalg.root_psd(MOTION.noise_cov(pose, u)) @ noise)

    key, first = jax.random.split(key)
    noise = jax.random.normal(first, (PARTICLES, count, 2))
    poses = jnp.zeros((PARTICLES, 3))

    def step(carry, row):
        poses, maps, key, born = carry
        key, drive, again = jax.random.split(key, 3)
        poses = jax.vmap(moved, (0, None, 0))(
            poses, row.control, jax.random.normal(drive, (PARTICLES, 2))
        )
        z = row.scan.z[jnp.argsort(row.scan.tag)]
        seen = jax.vmap(jax.vmap(place), (None, 0))(z, noise)
        cos, sin = jnp.cos(poses[:, 2])[:, None], jnp.sin(poses[:, 2])[:, None]
        turned = jnp.stack(
            [cos * seen[..., 0] - sin * seen[..., 1], sin * seen[..., 0] + cos * seen[..., 1]], -1
        )
        maps = jnp.where(born, maps, poses[:, None, :2] + turned)
        weight = jax.vmap(lambda p, m: jax.vmap(density, (None, 0, 0))(p, m, z).sum())(poses, maps)
        weight = jnp.where(born, weight, 0.0)
        ess = 1 / (jax.nn.softmax(weight) ** 2).sum()
        chosen = systematic(weight, again)
        return (poses[chosen], maps[chosen], key, jnp.asarray(True)), ess

    maps = jnp.zeros((PARTICLES, count, 2))
    (_, maps, _, _), ess = jax.lax.scan(step, (poses, maps, key, jnp.asarray(False)), log)
    return maps.mean(axis=0), ess[1:].mean()


def measure(quick: bool = False) -> list[Metric]:
    runs, rows = 8 if quick else 20, {}
    for count in LANDMARKS:
        scene = world(count)
        filter = filters.FastSlam(scene.motion, scene.sensor, count, PARTICLES)

        def one(key, scene=scene, filter=filter, count=count):
            truth, log = simulate(scene, key)
            points, ess = plain(log, key, count)
            start = jnp.zeros(3), jnp.zeros((3, 3)), key
            estimate = jax.tree.map(lambda x: x[-1], run(filter, log, *start).estimate)
            off = estimate.points - truth.landmarks[estimate.tag]
            mine = points - truth.landmarks
            return (mine**2).sum(axis=1).mean(), (off**2).sum(axis=1).mean(), ess

        keys = jax.random.split(jax.random.key(3), runs)
        square, rao, ess = jax.jit(lambda keys, one=one: jax.lax.map(one, keys))(keys)
        rows[scene.name] = {
            "map RMSE [m]": float(np.sqrt(square.mean())),
            "of FastSLAM [m]": float(np.sqrt(rao.mean())),
            "effective particles": float(ess.mean()),
        }
    show(f"{runs} runs, {PARTICLES} particles, {STEPS} steps", rows)
    first, *_, last = (row["map RMSE [m]"] / row["of FastSLAM [m]"] for row in rows.values())
    what = "plain particles: map RMSE over FastSLAM's"
    return [Metric(f"{what}, 1 landmark", first), Metric(f"{what}, 20 landmarks", last, low=1.5)]
