"""Timing on one core: what a compiled function costs, and a C++ program beside it."""

import os
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

SOURCE = Path(__file__).with_name("ekf_limit.cpp")
REPEATS = 5


def pin() -> None:
    """This process and its children onto one core; before JAX is imported, which counts them."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


def best(action, repeats: int = REPEATS) -> float:
    """Seconds of the fastest of some calls."""
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        action()
        times.append(time.perf_counter() - began)
    return min(times)


def together(actions: dict, repeats: int = REPEATS) -> dict[str, float]:
    """Seconds of the fastest call of each, in turn, so that a slow minute falls on all."""
    times = {name: [] for name in actions}
    for _ in range(repeats):
        for name, action in actions.items():
            times[name].append(best(action, 1))
    return {name: min(each) for name, each in times.items()}


class Limit:
    """The hand-written program, compiled here for one precision; None where there is no g++."""

    def __init__(self, dtype: str) -> None:
        self.folder = tempfile.TemporaryDirectory()
        self.program = Path(self.folder.name) / "limit"
        flags = ["-O3", "-march=native", "-ffast-math"]
        flags += ["-DREAL=float"] if dtype == "float32" else []
        self.there = shutil.which("g++") is not None
        if self.there:
            command = ["g++", *flags, str(SOURCE), "-o", str(self.program)]
            subprocess.run(command, check=True)

    def run(self, runs: int) -> None:
        command = [str(self.program), str(runs), "200", "7"]  # steps; columns a side
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
