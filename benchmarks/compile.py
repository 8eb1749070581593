"""What a first run waits for.

Seconds of tracing, lowering and XLA's compilation of one run of every filter of the catalogue, of
`DelayedSlam`, `TeamSlam`, an EKF with life and merging, the smoother and the batch solution,
and of gradients through runs of an EKF; how many programs XLA compiled when the same was run again
with every noise, gate and map value changed (asked: none); and what a second call of `run` costs
beyond its program. Compilation does not depend on the number of steps. Idle machine, please. Quick
runs nothing a second time.
"""

import dataclasses
import itertools
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.delayed import named
from benchmarks.gate import Metric
from jaxslam import (
    Scenario,
    TeamWorld,
    World,
    catalog,
    life,
    motion,
    run,
    sensors,
    simulate,
    smoothing,
    team,
)
from jaxslam.consistency.campaign._candidates import estimator_of
from jaxslam.core.protocols import Filter
from jaxslam.core.types import Log, Trace, Truth
from jaxslam.filters import EkfSlam, Merging, TeamSlam
from jaxslam.sensors import Part, Suite
from jaxslam.simulation.scenarios import circle

GATE, DELAYED_GATE = 8.0, 10.0
STEPS = 20
OVERHEAD_MS = 2.0


def world(scale: float) -> Scenario:
    """`circle`, every number times the scale."""
    there = circle(STEPS)
    return dataclasses.replace(
        there,
        motion=motion.Increment(np.diag([0.02, 0.01]) ** 2 * scale),
        sensor=sensors.RangeBearing(np.diag([0.3, 0.03]) ** 2 * scale),
        landmarks=np.asarray(there.landmarks) * scale,
        controls=np.asarray(there.controls)[:, :2] * scale,
        filter_options={},
    )


def crew(scale: float) -> tuple[World, Filter]:
    eyes = sensors.RangeBearing(np.diag([0.05, 0.02]) ** 2 * scale)
    sees = Suite((Part(eyes, 4), Part(eyes, 1, interval=2, sees="robots")))
    moves = motion.Increment(np.diag([0.01, 0.01]) ** 2 * scale)
    second = (0.8, 0.6, 1.0), np.diag([0.05, 0.05, 0.05]) ** 2
    robots = [team.Robot(moves, sees), team.Robot(moves, sees, second)]
    points = 3.0 * scale * np.stack([np.cos(np.arange(8)), np.sin(np.arange(8))], axis=1)
    controls = np.tile([0.12, 0.1, 0.12, -0.1], (STEPS, 1))
    return TeamWorld(robots, points, controls), TeamSlam(robots, 8)


NAMES = (*catalog.ALL, "delayed_slam", "team_slam", "life and merging", "smooth", "batch_map")


def case(name: str, scale: float) -> tuple[World, Any]:
    """A world and a filter, or an estimator, with every number scaled."""
    if name == "delayed_slam":
        there, filters = named(6)
        controls = np.asarray(there.controls)[:STEPS] * scale
        return dataclasses.replace(there, controls=controls), filters["delayed"]
    if name == "team_slam":
        return crew(scale)
    there = world(scale)
    parts = there.motion, there.sensor, len(there.landmarks)
    if name == "life and merging":
        keeps = life.Existence(there.visible, detected=0.9 * scale, patience=50)
        return there, Merging(EkfSlam(*parts, correction="joint", life=keeps), 0.5 * scale)
    if name == "smooth":
        return there, smoothing.Smoother(*parts, there.pose, there.pose_cov)
    if name == "batch_map":
        return there, smoothing.BatchMap(*parts, there.pose, there.pose_cov)
    return there, catalog.ALL[name](there, gate=0.9 * scale)


@jax.jit
def drive(method: Any, there: World, truth: Truth, log: Log, key: jax.Array) -> Trace:
    """The trace of a campaign's candidate over a log."""
    estimate, _ = estimator_of(method, truth, there)
    return estimate(log, key)


def first_run(name: str, program: Any, *arguments: Any) -> Metric:
    """Seconds of tracing, lowering and compiling a jitted function, which are printed."""
    began = time.perf_counter()
    traced = program.trace(*arguments)
    at = time.perf_counter()
    lowered = traced.lower()
    then = time.perf_counter()
    lowered.compile()
    taken = at - began, then - at, time.perf_counter() - then
    print(f"{name:24} " + " ".join(f"{x:7.2f}" for x in taken) + f" {sum(taken):8.2f}", flush=True)
    high = DELAYED_GATE if name == "delayed_slam" else GATE
    return Metric(f"{name}: first run [s]", sum(taken), high=high)


def measure(quick: bool = False) -> list[Metric]:
    count = [0]

    def listen(event: str, *_: Any, **__: Any) -> None:
        count[0] += event == "/jax/core/compile/backend_compile_duration"

    jax.monitoring.register_event_duration_secs_listener(listen)
    metrics = []
    key = jax.random.key(0)
    print(f"{'':24} {'trace':>7} {'lower':>7} {'XLA':>7} {'sum [s]':>8}")
    for name in NAMES:
        there, method = case(name, 1.0)
        truth, log = simulate(there, key)
        metrics.append(first_run(name, drive, method, there, truth, log, key))
        if quick:
            continue
        jax.block_until_ready(drive(method, there, truth, log, key))
        there, method = case(name, 1.07)
        truth, log = simulate(there, key)
        before = count[0]
        jax.block_until_ready(drive(method, there, truth, log, key))
        metrics.append(Metric(f"{name}: compiled for other numbers", count[0] - before, high=0.0))
        jax.clear_caches()
    jax.monitoring.unregister_event_duration_listener(listen)
    return metrics + gradients(key) + overhead(key)


def gradients(key: jax.Array) -> list[Metric]:
    """Compiling ∂ log-likelihood / ∂ (noise, mount) of runs."""
    there = world(1.0)
    _, log = simulate(there, key)
    at = jnp.asarray([0.3, 0.03, 0.0, 0.0, 0.0])
    metrics = []
    for correction in ("joint", "sequential"):

        def cost(p: jax.Array, log: Any, correction: str = correction) -> jax.Array:
            sensor = sensors.RangeBearing(jnp.diag(p[:2]) ** 2, mount=p[2:])
            ekf = EkfSlam(there.motion, sensor, len(there.landmarks), correction=correction)
            trace = run(ekf, log, there.pose, there.pose_cov, key)
            return trace.info.log_likelihood.sum()

        program = jax.jit(jax.value_and_grad(cost))
        metrics.append(first_run(f"gradient, {correction}", program, at, log))
    return metrics


def overhead(key: jax.Array) -> list[Metric]:
    """What `run` costs beyond its program: again with the same objects, and with a filter that was
    made with other noises."""
    there = world(1.0)
    count = len(there.landmarks)
    ekf = EkfSlam(there.motion, there.sensor, count, correction="joint")
    others = itertools.cycle(
        EkfSlam(world(1.0 + 0.01 * k).motion, there.sensor, count, correction="joint")
        for k in range(1, 21)
    )
    _, log = simulate(there, key)
    arguments = log, jnp.asarray(there.pose, float), jnp.asarray(there.pose_cov, float), key

    def again(log: Any, pose: Any, pose_cov: Any, key: jax.Array) -> Any:
        return run(ekf, log, pose, pose_cov, key)

    def rebuilt(log: Any, pose: Any, pose_cov: Any, key: jax.Array) -> Any:
        return run(next(others), log, pose, pose_cov, key)

    compiled = jax.jit(again).lower(*arguments).compile()

    def median(call: Callable[..., Any]) -> float:
        taken = []
        for _ in range(201):
            began = time.perf_counter()
            jax.block_until_ready(call(*arguments))
            taken.append(time.perf_counter() - began)
        return float(np.median(taken[1:])) * 1e3

    program = median(compiled)
    beyond, beyond_rebuilt = median(again) - program, median(rebuilt) - program
    draw = median(lambda *_: simulate(there, key))
    return [
        Metric("run again, beyond its program [ms]", beyond, high=OVERHEAD_MS),
        Metric("run of a rebuilt filter, beyond [ms]", beyond_rebuilt, high=OVERHEAD_MS),
        Metric("simulate again [ms]", draw, high=OVERHEAD_MS),
    ]
