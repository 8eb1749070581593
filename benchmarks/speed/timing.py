"""Timing on one core, and C++ programs to time beside."""

import os
import subprocess
import time
from pathlib import Path

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


def compiled_cpp(source: Path, folder: str, *flags: str) -> str:
    """The program of a C++ file, made in a folder."""
    program = str(Path(folder) / source.stem)
    options = ["-O3", "-march=native", "-ffast-math", *flags]
    subprocess.run(["c++", *options, str(source), "-o", program], check=True)
    return program
