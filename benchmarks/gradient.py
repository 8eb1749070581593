"""What a gradient through a whole run costs: `python -m benchmarks.gradient`.

The log-likelihood of 200 steps of `cloister`, driven by a steered car, by the noise, the mounting
pose and the wheelbase (8 parameters): time of `jax.value_and_grad` over that of the forward run,
both compiled, and the memory it holds. With joint correction; place by place, each of 7,200 small
corrections is many small programs on the way back, and the ratio is several times as large.
"""

import dataclasses
import time

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.gate import Metric, report
from jaxslam.filters.ekf_slam import ekf_slam
from jaxslam.motion.ackermann import ackermann
from jaxslam.run import run
from jaxslam.scenarios import cloister
from jaxslam.sensors.range_bearing import range_bearing
from jaxslam.simulate import simulate

WHEELBASE, SPEED, DT = 0.5, 1.0, 0.1
AT = np.array([0.1, 0.09, 0.1, np.deg2rad(1.0), 0.0, 0.0, 0.0, WHEELBASE])


def models(p):
    car = ackermann(jnp.diag(p[:2]) ** 2, wheelbase=p[7], sensor=(0.0, 0.0), encoder=0.0)
    return car, range_bearing(jnp.diag(p[2:4]) ** 2, mount=p[4:7])


def measure(update: str = "joint") -> list[Metric]:
    car, sensor = models(AT)
    steering = np.arctan(0.05 * WHEELBASE / (SPEED * DT))
    controls = np.tile([SPEED, steering, DT], (200, 1))
    world = dataclasses.replace(cloister(), motion=car, sensor=sensor, controls=controls)
    _, log = jax.jit(lambda key: simulate(world, key))(jax.random.key(0))

    def log_likelihood(p, log, checkpoint=False):
        car, sensor = models(p)
        ekf = ekf_slam(car, sensor, 36, update=update, births=1)
        key = jax.random.key(1)
        trace = run(ekf, log, world.pose, world.pose_cov, key, checkpoint=checkpoint)
        return trace.info.log_likelihood.sum()

    forward, _ = _timed(log_likelihood, log)
    plain, held = _timed(jax.value_and_grad(log_likelihood), log)
    again = jax.value_and_grad(lambda p, log: log_likelihood(p, log, checkpoint=True))
    seconds, held_again = _timed(again, log)
    name = f"cloister, {update}, "
    return [
        Metric(name + "forward run [s]", forward),
        Metric(
            name + "gradient / forward",
            plain / forward,
            high=6.0 if update == "joint" else float("inf"),
            note=f"{held / 1e6:.1f} MB",
        ),
        Metric(
            name + "gradient / forward, checkpoint",
            seconds / forward,
            high=6.0 if update == "joint" else float("inf"),
            note=f"{held_again / 1e6:.1f} MB",
        ),
    ]


def _timed(function, log) -> tuple[float, int]:
    """Best of five seconds, and the bytes of temporary memory."""
    compiled = jax.jit(function).lower(AT, log).compile()
    jax.block_until_ready(compiled(AT, log))
    best = float("inf")
    for _ in range(5):
        began = time.perf_counter()
        jax.block_until_ready(compiled(AT, log))
        best = min(best, time.perf_counter() - began)
    return best, compiled.memory_analysis().temp_size_in_bytes


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    raise SystemExit(report(measure() + measure("sequential")))
