"""Whole campaigns through the command: throughput and memory, and two processes against one."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.gate import child

MEASURE = """
import json, resource, sys
from benchmarks.speed.timing import pin
if sys.argv[2] == "pinned": pin()
import time, jax
jax.config.update("jax_enable_x64", True)
from jaxslam import catalog, monte_carlo, scenarios
world = scenarios.cloister()
marks = []
campaign = monte_carlo(
    world, {"ekf": catalog.FILTERS["ekf"](world)}, int(sys.argv[1]), jax.random.key(0),
    progress=lambda done, total: marks.append((time.perf_counter(), done)),
)
begin = marks[min(len(marks) // 4, 8)]
rate = (marks[-1][1] - begin[1]) / (marks[-1][0] - begin[0])
memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
alone = 0.0
if sys.argv[2] == "pinned":
    from benchmarks.speed.single import RUNS, filter_alone
    alone = RUNS / filter_alone(world)
print(json.dumps([rate, memory, alone]))
"""


def campaign(runs: int, where: str = "free") -> tuple[float, float, float]:
    """Runs a second once compiled, peak memory [MB] of the process; and on one core ("pinned") also
    the runs a second of its filter alone."""
    rate, memory, alone = child("-c", MEASURE, runs, where)
    return rate, memory, alone


def processes(count: int, runs: int) -> float:
    """Seconds a block takes with a part of the campaign a process, and a core each, from the first
    block that each keeps, before which it compiled."""
    cores = sorted(os.sched_getaffinity(0))[:count]
    with tempfile.TemporaryDirectory() as folder:
        ask = ["consistency", "--scenario", "cloister", "--runs", str(runs)]
        ask += ["--devices", "1", "--out", folder]
        started = []
        for i, core in enumerate(cores):
            own = ["--part", f"{i + 1}/{count}"]
            pinned = ["taskset", "-c", str(core), sys.executable, "-m", "jaxslam", *ask, *own]
            started.append(subprocess.Popen(pinned, stdout=subprocess.DEVNULL))
        for process in started:
            if process.wait() != 0:
                raise RuntimeError(f"process {process.args} failed")
        kept = sorted((Path(folder) / "blocks").glob("*.npz"))
        # A part has each count-th block.
        rates = [_rate([p.stat().st_mtime for p in kept[i::count]]) for i in range(count)]
    return 1 / sum(rates)


def _rate(times: list[float]) -> float:
    """Pieces a second from the first on."""
    return (len(times) - 1) / (max(times) - min(times))
