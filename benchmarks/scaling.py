"""What a step costs as the map grows, 10 landmarks of it in view.

Claims of the sources, as measured exponents: a step of EKF-SLAM is O(N²) (Solà 2.3.3; Tacher 1 has
O(N^ω), of a dense product), of localization O(M) in the measurements of a scan (Tacher 1 has O(N),
for a scan of all landmarks) but for the look-up of tags, of SEIF O(1) (Notes), of FastSLAM
O(P log N) where maps are shared in trees (Montemerlo et al. 2002); here they are arrays, copied by
resampling, O(P·N).

A robot drives along a ring of landmarks 1 m apart that all are in its map. Prediction and update
are timed in a scan whose carry is donated, without estimates, which are O(N) by themselves. Each
time is the least of some.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.gate import Metric
from jaxslam import filters, motion, sensors
from jaxslam.core.types import Log, Scan
from jaxslam.math.numpy_poses import wrapped

KEY = jax.random.key(0)
SEEN, PARTICLES = 10, 100
SPACING, OFFSET = 1.0, 2.0
SIZES = (10, 30, 100, 300, 1000, 3000, 10000)
MOTION = motion.Increment(np.diag([0.01, 0.001]) ** 2)
SENSOR = sensors.RangeBearing(np.diag([0.1, 0.02]) ** 2)


def ring(count: int, steps: int) -> tuple[np.ndarray, Log]:
    """Landmarks (N, 2), and what a robot that starts at the origin measures of those nearest."""
    around = 2 * np.pi * np.arange(count) / count
    radius = SPACING * count / (2 * np.pi)
    points = (radius + OFFSET) * np.stack([np.sin(around), -np.cos(around)], axis=1) + [0, radius]
    controls = np.tile([0.5, 0.5 / radius], (steps, 1))
    z, tags, pose = [], [], np.zeros(3)
    for forward, turn in controls:
        pose = pose + [forward * np.cos(pose[2]), forward * np.sin(pose[2]), turn]
        away = points - pose[:2]
        tag = np.sort(np.argsort(np.hypot(*away.T))[:SEEN])
        bearing = wrapped(np.arctan2(away[tag, 1], away[tag, 0]) - pose[2])
        z.append(np.stack([np.hypot(*away[tag].T), bearing], axis=1))
        tags.append(tag)
    valid = np.ones((steps, SEEN), bool)
    return points, Log(controls, Scan(np.array(z), np.array(tags, np.int32), valid))


def start(filter):
    return filter.init(jnp.zeros(3), 1e-4 * jnp.eye(3))


def ekf(points):
    filter = filters.EkfSlam(MOTION, SENSOR, len(points), correction="joint")
    return filter, known(start(filter), points)


def known(joint, points):
    """A map that was seen; landmarks are correlated with nothing, which costs the same."""
    count = len(points)
    variance = np.concatenate([[1e-4] * 3, np.full(2 * count, 0.01)])
    return joint._replace(
        landmarks=jnp.asarray(points),
        cov=jnp.diag(jnp.asarray(variance)),
        alive=jnp.ones(count, bool),
        tag=jnp.arange(count, dtype=jnp.int32),
    )


def seif(points):
    """20 landmarks active, 30 links; each is linked to the 8 around it, all passive so far."""
    count = len(points)
    filter = filters.Seif(MOTION, SENSOR, count, active=min(20, count), links=30)
    state = start(filter)
    near = (np.arange(count)[:, None] + np.array([-4, -3, -2, -1, 1, 2, 3, 4])) % count
    links, index = np.zeros(state.links.shape), np.array(state.neighbours)
    links[:, :8], index[:, :8] = -20.0 * np.eye(2), near
    return filter, state._replace(
        landmarks=jnp.asarray(points),
        alive=jnp.ones(count, bool),
        diagonal=jnp.broadcast_to(200.0 * jnp.eye(2), state.diagonal.shape),
        neighbours=jnp.asarray(index),
        links=jnp.asarray(links),
    )


def fastslam(points):
    count = len(points)
    filter = filters.FastSlam(MOTION, SENSOR, count, PARTICLES)
    state = start(filter)
    return filter, state._replace(
        landmarks=jnp.broadcast_to(jnp.asarray(points), state.landmarks.shape),
        covs=jnp.broadcast_to(0.01 * jnp.eye(2), state.covs.shape),
        alive=jnp.ones(state.alive.shape, bool),
        tag=jnp.broadcast_to(jnp.arange(count, dtype=jnp.int32), state.tag.shape),
    )


def localization(points):
    filter = filters.Localization(MOTION, SENSOR, points, correction="joint")
    return filter, start(filter)


METHODS = {
    "EKF-SLAM": (ekf, 300, 3000, 1.6, 2.2),  # at 10,000 P alone has 3.2 GB
    "SEIF": (seif, 100, 10000, -0.1, 0.1),
    f"FastSLAM 2.0, {PARTICLES} particles": (fastslam, 1000, 10000, -0.1, 1.2),
    "localization": (localization, 100, 10000, -0.1, 0.5),
}
"""Filter and map, the sizes between which the power of N is taken, and its gate. Localization looks
its tags up among N, a few microseconds that grow."""


def seconds_a_step(make, count: int, steps: int, repeats: int = 3) -> float:
    """Of a robot that drives along the ring, a landmark every other step."""
    points, log = ring(count, steps)
    filter, state = make(points)

    def drive(state, log):
        def step(state, row):
            state, _ = filter.update(filter.predict(state, row.control, KEY), row.scan, KEY)
            return state, None

        return jax.lax.scan(step, state, log)[0]

    go = jax.jit(drive, donate_argnums=0)
    times = []
    for _ in range(repeats + 1):
        own = jax.block_until_ready(jax.tree.map(jnp.array, state))
        began = time.perf_counter()
        done = jax.block_until_ready(go(own, log))
        times.append(time.perf_counter() - began)
    assert all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves(done) if x.dtype.kind == "f")
    return min(times[1:]) / steps


def measure(quick: bool = False) -> list[Metric]:
    metrics = []
    for name, (make, low, high, *gate) in METHODS.items():
        sizes = [size for size in SIZES if size <= high]
        times = {n: seconds_a_step(make, n, 100 if n <= 300 else 30) for n in sizes}
        print(f"{name:28}" + "  ".join(f"{n}: {1e3 * s:.3f} ms" for n, s in times.items()))
        rows = np.log([(n, s) for n, s in times.items() if n >= low])
        power = float(np.polyfit(*rows.T, 1)[0])
        what = f"{name}: step as a power of N, {low} to {high:,}"
        metrics.append(Metric(what, power, *gate))
    return metrics
