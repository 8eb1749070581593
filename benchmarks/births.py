"""What a new landmark costs as the map grows.

Solà 2.3.4: the initialization of a landmark is O(N), since only its rows and columns are written. A
birth alone is timed in a scan whose carry is donated, and a step of EKF-SLAM with ten measurements,
of known landmarks and with a new one among them. Each time is the least of some.
"""

import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from benchmarks import scaling
from benchmarks.gate import Metric
from jaxslam.core import slots
from jaxslam.filters import EkfSlam

STEPS, REPEATS = 20, 5
SIZES, LOWEST = (100, 300, 1000, 3000), 300
"""Landmarks, and the least of them for the power; below it the start of each program counts."""

IN_STEPS = (300, 1000)


def least(program: Callable[..., PyTree], state: PyTree, *rest: PyTree) -> float:
    """Seconds a step of a program that is given its first argument."""
    times = []
    for _ in range(REPEATS + 1):
        own = jax.block_until_ready(jax.tree.map(jnp.array, state))
        began = time.perf_counter()
        jax.block_until_ready(program(own, *rest))
        times.append(time.perf_counter() - began)
    return min(times[1:]) / STEPS


def birth_alone(count: int) -> float:
    """Of one landmark in a map with room for `count`."""

    def drive(joint: slots.Joint, landmarks: jax.Array) -> slots.Joint:
        def step(joint: slots.Joint, landmark: jax.Array) -> tuple[slots.Joint, None]:
            slot, granted = slots.allocate(joint.alive, jnp.ones(1, bool))
            by_pose = jnp.array([[[1.0, 0.0, -1.0], [0.0, 1.0, 1.0]]])
            own = 0.01 * jnp.eye(2)[None]
            tag = jnp.zeros(1, jnp.int32)
            return slots.scatter(joint, slot, granted, landmark, by_pose, own, tag), None

        return jax.lax.scan(step, joint, landmarks)[0]

    empty = slots.empty(jnp.zeros(3), 1e-4 * jnp.eye(3), count, 2)
    return least(jax.jit(drive, donate_argnums=0), empty, jnp.ones((STEPS, 1, 2)))


def step_times(count: int, correction: str) -> tuple[float, float]:
    """Of a step with ten known landmarks, and with nine and a new one."""
    points, log = scaling.ring(count, STEPS)
    ekf = EkfSlam(scaling.MOTION, scaling.SENSOR, count, correction=correction)
    full = scaling.known(scaling.start(ekf), points)
    away = np.arange(count) // STEPS == count // STEPS // 2  # where the robot does not come
    room = slots.remove(full, jnp.asarray(away))
    tag = np.array(log.scan.tag)
    tag[:, -1] = count + np.arange(STEPS)
    new = log._replace(scan=log.scan._replace(tag=tag))

    def drive(joint: slots.Joint, log: PyTree) -> slots.Joint:
        def step(joint: slots.Joint, row: PyTree) -> tuple[slots.Joint, None]:
            moved = ekf.predict(joint, row.control, scaling.KEY)
            return ekf.update(moved, row.scan, scaling.KEY)[0], None

        return jax.lax.scan(step, joint, log)[0]

    program = jax.jit(drive, donate_argnums=0)
    after = program(jax.tree.map(jnp.array, room), new)
    assert after.alive.all(), "a landmark was not initialized"
    return least(program, room, log), least(program, room, new)


def measure(quick: bool = False) -> list[Metric]:
    sizes = [size for size in SIZES if size <= 1000 or not quick]
    times = {n: birth_alone(n) for n in sizes}
    print("a birth alone  " + "  ".join(f"{n}: {1e3 * s:.4f} ms" for n, s in times.items()))
    rows = np.log([(n, s) for n, s in times.items() if n >= LOWEST])
    power = float(np.polyfit(*rows.T, 1)[0])
    what = f"a birth as a power of N, {LOWEST} to {max(sizes):,}"
    metrics = [Metric(what, power, high=1.2)]
    for correction in ("joint", "sequential"):
        for n in IN_STEPS:
            without, with_one = step_times(n, correction)
            text = f"{1e3 * without:.3f} ms, with a birth {1e3 * with_one:.3f} ms"
            print(f"{correction} correction, {n}: a step of ten measurements {text}")
            gate = {"high": 1.5} if n == 1000 else {}
            name = f"{correction}, {n:,} landmarks: a step with a birth / without"
            metrics.append(Metric(name, with_one / without, **gate))
    return metrics
