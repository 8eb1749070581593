"""The commands as a user runs them."""

import subprocess
import sys
import tempfile
import time

from benchmarks.gate import Metric


def measure(quick: bool = False) -> list[Metric]:
    """Seconds, with imports and compilation."""
    metrics = []
    for name, what in (("consistency", "100 runs"), ("verify", "every model")):
        with tempfile.TemporaryDirectory() as folder:
            began = time.perf_counter()
            subprocess.run([sys.executable, "-m", "jaxslam", name, "--out", folder], check=True)
        seconds = time.perf_counter() - began
        metrics.append(Metric(f"jaxslam {name}, {what} [s]", seconds, high=60.0))
    return metrics
