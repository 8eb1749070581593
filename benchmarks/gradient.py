"""What a gradient through a whole run costs.

The log-likelihood of 200 steps of `cloister`, driven by a steered car, by the noise, the mounting
pose and the wheelbase (8 parameters): time of `jax.value_and_grad` over that of the forward run,
both compiled, and the memory it holds; with joint and with sequential correction.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.gate import Metric
from benchmarks.speed.timing import together
from jaxslam import run, simulate
from jaxslam.filters import EkfSlam
from jaxslam.motion import Ackermann
from jaxslam.sensors import RangeBearing
from jaxslam.simulation.scenarios import cloister

ROUNDS = 15
WHEELBASE, SPEED, DT = 0.5, 1.0, 0.1
AT = np.array([0.1, 0.09, 0.1, np.deg2rad(1.0), 0.0, 0.0, 0.0, WHEELBASE])


def models(p):
    car = Ackermann(jnp.diag(p[:2]) ** 2, wheelbase=p[7], sensor=(0.0, 0.0), encoder=0.0)
    return car, RangeBearing(jnp.diag(p[2:4]) ** 2, mount=p[4:7])


def measure(quick: bool = False) -> list[Metric]:
    return cost_of("joint") + cost_of("sequential")


def cost_of(correction: str) -> list[Metric]:
    car, sensor = models(AT)
    steering = np.arctan(0.05 * WHEELBASE / (SPEED * DT))
    controls = np.tile([SPEED, steering, DT], (200, 1))
    world = dataclasses.replace(cloister(), motion=car, sensor=sensor, controls=controls)
    _, log = jax.jit(lambda key: simulate(world, key))(jax.random.key(0))

    def log_likelihood(p, log):
        car, sensor = models(p)
        ekf = EkfSlam(car, sensor, 36, correction=correction, births=1)
        key = jax.random.key(1)
        trace = run(ekf, log, world.pose, world.pose_cov, key)
        return trace.info.log_likelihood.sum()

    functions = {"forward": log_likelihood, "gradient": jax.value_and_grad(log_likelihood)}
    programs = {name: jax.jit(f).lower(AT, log).compile() for name, f in functions.items()}
    actions = {
        name: lambda program=program: jax.block_until_ready(program(AT, log))
        for name, program in programs.items()
    }
    seconds = together(actions, ROUNDS)
    forward, both = seconds["forward"], seconds["gradient"]
    held = programs["gradient"].memory_analysis().temp_size_in_bytes / 1e6
    name, gate = f"cloister, {correction}, ", 6.0 if correction == "joint" else float("inf")
    return [
        Metric(name + "forward run [s]", forward),
        Metric(name + "gradient / forward", both / forward, high=gate, note=f"{held:.1f} MB"),
    ]
