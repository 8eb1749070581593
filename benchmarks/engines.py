"""A campaign of `cloister` from Python, beside a C++ loop, and on an executor.

The rate of the default call in a process with the one CPU device that JAX has, beside that with a
device a core, as the command sets them; that of a process on one core (worlds, filter and scores)
beside the filter alone in C++ (`speed/ekf_limit.cpp`); and that of an executor of one process,
beside the same blocks without one, both on one core. All are timed in turns.
"""

import json
import os
import pickle
import statistics
import subprocess
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path

import jax

from benchmarks.gate import Metric, child
from benchmarks.speed import timing
from benchmarks.speed.campaigns import campaign
from jaxslam import catalog, monte_carlo, scenarios
from jaxslam.consistency.campaign import Processes
from jaxslam.consistency.campaign._block import CampaignPlan
from jaxslam.consistency.campaign._remote import compute_block, pack

RUNS, BLOCK = 512, 16
DEVICES = "--xla_force_host_platform_device_count="


def measure(quick: bool = False) -> list[Metric]:
    """Rates in turns, their medians; bytes of a block."""
    repeats = 1 if quick else 3
    one, many, ours, limit = [], [], [], []
    with tempfile.TemporaryDirectory() as folder:
        source = Path(timing.__file__).with_name("ekf_limit.cpp")
        program = timing.compiled_cpp(source, folder)
        for _ in range(repeats):
            one.append(with_devices(1))
            many.append(with_devices(os.cpu_count()))
            ours.append(campaign(RUNS, "pinned")[0])
            command = ["taskset", "-c", "0", program, "64", "200", "7"]  # runs, steps, columns
            limit.append(64 / timing.best(lambda: subprocess.run(command, check=True), 3))
    alone, sent, there, back = child("-m", "benchmarks.engines")
    overhead = statistics.median(sent) / statistics.median(alone) - 1
    in_python, by_command, of_core, of_limit = map(statistics.median, (one, many, ours, limit))
    return [
        Metric("one device, default call [runs/s]", in_python),
        Metric("a device a core [runs/s]", by_command),
        Metric("one device / a device a core", in_python / by_command, low=0.9),
        Metric("campaign on one core [runs/s]", of_core),
        Metric("campaign / C++, on one core", of_core / of_limit, low=0.8),
        Metric("a block of 16 on a worker [s]", statistics.median(sent)),
        Metric("what an executor adds to it", overhead, high=0.05),
        Metric("bytes sent with a block", there, high=10_000),
        Metric("bytes of its result", back, high=100_000),
    ]


def with_devices(count: int | None) -> float:
    """Runs a second of the default call in a process with so many CPU devices."""
    code = f"import os; os.environ['XLA_FLAGS'] = '{DEVICES}{count}'\n"
    return child("-c", code + _TIMED)


_TIMED = f"""
import json, time, jax
jax.config.update("jax_enable_x64", True)
from jaxslam import catalog, monte_carlo, scenarios
world, marks = scenarios.cloister(), []
monte_carlo(world, {{"ekf": catalog.FILTERS["ekf"](world)}}, {RUNS}, jax.random.key(0),
    progress=lambda done, _: marks.append((time.perf_counter(), done)))
begin = marks[len(marks) // 4]
print(json.dumps((marks[-1][1] - begin[1]) / (marks[-1][0] - begin[0])))
"""


def on_one_core() -> tuple[list[float], list[float], int, int]:
    """Seconds a block without and with an executor, and the bytes of a block there and back."""
    timing.pin()
    jax.config.update("jax_enable_x64", True)
    world, marks = scenarios.cloister(), []
    filters, key = {"ekf": catalog.FILTERS["ekf"](world)}, jax.random.key(0)
    content = pack(CampaignPlan(world, filters, key, jax.devices()[:1], BLOCK))
    back = len(pickle.dumps(compute_block(content, BLOCK, BLOCK)))

    def seconds(**options) -> list[float]:
        marks.clear()
        mark = lambda *_: marks.append(time.perf_counter())  # noqa: E731
        monte_carlo(world, filters, RUNS, key, block=BLOCK, progress=mark, **options)
        return [b - a for a, b in pairwise(marks[2:])]

    pool = Processes(1)
    try:
        found = ([], [])
        for _ in range(3):
            found[0].extend(seconds(workers=1))
            found[1].extend(seconds(executor=pool))
    finally:
        pool.shutdown()
    return *found, len(content), back


if __name__ == "__main__":
    print(json.dumps(on_one_core()), file=sys.stdout)
