"""A plain particle filter over path and map against FastSLAM.

Williams's reason for Rao-Blackwellization: the number of particles that a posterior needs grows
exponentially with its dimension, 3 + 2N for the joint state (x, y, θ, l_1 … l_N). Two measurements:
at a fixed number of particles the error by N; and the number needed for one accuracy by N, the
smallest power of 2 at which the map's RMSE is at most 1.1 times that of FastSLAM with 500. FastSLAM
samples the pose alone and keeps each landmark as a Gaussian given the path. Same draws for both, a
robot on a circle inside N landmarks that it always sees. The needed number is of short logs, of 16
scans: each further scan narrows the posterior against the first scan, from which landmarks are
drawn, so that long logs need more.
"""

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.gate import Metric, save, show
from jaxslam import Scenario, filters, motion, run, sensors, simulate
from jaxslam.math import _gaussians as gaussians
from jaxslam.math import _linalg as linalg
from jaxslam.resampling import systematic
from jaxslam.results.plot import COLORS, COLUMN, INK, caption, panels_of

MOTION = motion.Increment(np.diag([0.01, 0.01]) ** 2)
SENSOR = sensors.RangeBearing(np.diag([0.1, 0.03]) ** 2)
LANDMARKS = (1, 2, 5, 10, 20)
STEPS = 100
PARTICLES = 500
SHORT, NEEDED, WITHIN = 16, (1, 2, 3, 4), 1.1
"""Scans of a log, landmarks, and the accuracy, relative to FastSLAM, of the needed number."""
MOST = 2**19
"""Particles at most."""


def world(count: int, steps: int = STEPS) -> Scenario:
    around = 2 * np.pi * np.arange(count) / count
    return Scenario(
        name=f"{count} landmarks",
        motion=MOTION,
        sensor=SENSOR,
        landmarks=np.stack([4 * np.cos(around), 1.5 + 4 * np.sin(around)], axis=1),
        controls=np.tile([0.1, 2 * np.pi / STEPS], (steps, 1)),
    )


def plain(log, key, count: int, particles: int = PARTICLES):
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
    noise = jax.random.normal(first, (particles, count, 2))
    poses = jnp.zeros((particles, 3))

    def step(carry, row):
        poses, maps, key, born = carry
        key, drive, again = jax.random.split(key, 3)
        poses = jax.vmap(moved, (0, None, 0))(
            poses, row.control, jax.random.normal(drive, (particles, 2))
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

    maps = jnp.zeros((particles, count, 2))
    (_, maps, _, _), ess = jax.lax.scan(step, (poses, maps, key, jnp.asarray(False)), log)
    return maps.mean(axis=0), ess[1:].mean()


def rmse_of(count: int, particles: int, steps: int, keys) -> float:
    """Map RMSE [m] of the plain filter over the runs of some keys."""

    def one(key):
        truth, log = simulate(world(count, steps), key)
        return ((plain(log, key, count, particles)[0] - truth.landmarks) ** 2).sum(axis=1).mean()

    return float(np.sqrt(jax.jit(lambda keys: jax.lax.map(one, keys))(keys).mean()))


def rmse_of_fastslam(count: int, steps: int, keys) -> float:
    """The same of FastSLAM, with `PARTICLES`."""
    scene = world(count, steps)
    filter = filters.FastSlam(scene.motion, scene.sensor, count, PARTICLES)

    def one(key):
        truth, log = simulate(scene, key)
        trace = run(filter, log, jnp.zeros(3), jnp.zeros((3, 3)), key)
        estimate = jax.tree.map(lambda x: x[-1], trace.estimate)
        return ((estimate.points - truth.landmarks[estimate.tag]) ** 2).sum(axis=1).mean()

    return float(np.sqrt(jax.jit(lambda keys: jax.lax.map(one, keys))(keys).mean()))


def draw(found: list[int], factor: float) -> None:
    """The needed number by landmarks, and the exponential through its ends."""
    figure, (axes,) = panels_of(COLUMN, 2.4, 1)
    counts = np.arange(1, len(found) + 1)
    line = found[0] * factor ** (counts - 1.0)
    axes.semilogy(counts, line, color=INK, lw=0.8, label=f"factor {factor:.0f} a landmark")
    axes.semilogy(counts, found, "o", color=COLORS[0], ms=4, label="needed")
    axes.set(xlabel="landmarks", ylabel="particles of pose and map", xticks=counts)
    caption(figure, "Particles needed for one accuracy")
    save(figure, "plain_particles")


def needed(quick: bool) -> list[Metric]:
    """The needed number of particles by the number of landmarks, and the factor of one more."""
    keys, rows, found = jax.random.split(jax.random.key(5), 10 if quick else 40), {}, []
    for count in NEEDED[: 2 if quick else None]:
        fast, particles, ratio = rmse_of_fastslam(count, SHORT, keys), 8, np.inf
        while ratio > WITHIN and particles < MOST:
            particles *= 2
            ratio = rmse_of(count, particles, SHORT, keys) / fast
        rows[f"{count} landmarks"] = {
            "needed particles": f"{particles:,}" if ratio <= WITHIN else f"over {MOST:,}",
            "map RMSE over FastSLAM's": ratio,
            "of FastSLAM [m]": fast,
        }
        found.append(particles)
    show(f"{len(keys)} runs, {SHORT} scans, RMSE within {WITHIN} of FastSLAM's", rows)
    factor = float((found[-1] / found[0]) ** (1 / (len(found) - 1)))
    if not quick:
        draw(found, factor)
    what = "plain particles: needed number, factor of one more landmark"
    return [Metric(what, factor, low=2.0)]


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
    fixed = [Metric(f"{what}, 1 landmark", first), Metric(f"{what}, 20 landmarks", last, low=1.5)]
    return fixed + needed(quick)
