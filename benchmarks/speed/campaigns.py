"""Whole campaigns through the command: throughput and memory, and two processes against one."""

import json
import os
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

MEASURE = """
import json, resource, sys
from benchmarks.speed.timing import pin
if sys.argv[2] == "pinned": pin()
import time, jax
jax.config.update("jax_enable_x64", True)
from jaxslam import family, monte_carlo, scenarios
world = scenarios.cloister()
marks = []
campaign = monte_carlo(
    world, {"ekf": family.FILTERS["ekf"](world)}, int(sys.argv[1]), jax.random.key(0),
    progress=lambda done, total: marks.append((time.perf_counter(), done)),
)
begin = marks[min(len(marks) // 4, 8)]
rate = (marks[-1][1] - begin[1]) / (marks[-1][0] - begin[0])
print(json.dumps([rate, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024]))
"""


def campaign(runs: int, where: str = "free") -> tuple[float, float]:
    """Runs a second once compiled, and peak memory [MB] of the process."""
    command = [sys.executable, "-c", MEASURE, str(runs), where]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    rate, memory = json.loads(done.stdout.splitlines()[-1])
    return rate, memory


def processes(count: int, runs: int) -> float:
    """Seconds from the first block kept to the last, of processes with a core each."""
    cores = sorted(os.sched_getaffinity(0))[:count]
    with tempfile.TemporaryDirectory() as folder, socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
        free.close()
        ask = ["consistency", "--scenario", "cloister", "--no-bound", "--runs", str(runs)]
        ask += ["--devices", "1", "--out", folder]
        if count > 1:
            ask += ["--coordinator", address, "--processes", str(count)]
        started = []
        for i, core in enumerate(cores):
            own = ["--process-id", str(i)] if count > 1 else []
            pinned = ["taskset", "-c", str(core), sys.executable, "-m", "jaxslam", *ask, *own]
            started.append(subprocess.Popen(pinned, stdout=subprocess.DEVNULL))
        for process in started:
            if process.wait() != 0:
                raise RuntimeError(f"process {process.args} failed")
        times = sorted(p.stat().st_mtime for p in (Path(folder) / "blocks").glob("*.npz"))
    # The first block of each process holds its compilation.
    return (times[-1] - times[count - 1]) / (len(times) - count)
