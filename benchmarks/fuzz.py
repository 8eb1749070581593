"""The suite's fuzzed tests with more examples, `python -m benchmarks.fuzz [--times 20]`.

Logs of any numbers through every filter of the catalogue, the odd shapes too; and files of every
reader with a few bytes changed. What they assert stands in the tests.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

from benchmarks.gate import Metric, alone

ROOT = Path(__file__).parents[1]
TESTS = {
    "logs": "tests/conformance/test_fuzzed_logs.py",
    "files": "tests/datasets/test_mutated.py",
}


def measure(times: int = 20) -> list[Metric]:
    """times: how many times the examples of the suite; other ones at each call, of files."""
    metrics = []
    for what, path in TESTS.items():
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", path]
        env = os.environ | {"JAXSLAM_FUZZ": str(times)}
        done = subprocess.run(command, cwd=ROOT, env=env, stdout=subprocess.PIPE, text=True)
        said = done.stdout.splitlines()
        print("\n".join(said if done.returncode else said[-1:]), flush=True)
        found = re.search(r"(\d+) passed", done.stdout)
        metrics += [
            Metric(f"fuzzed {what}: status of the tests", done.returncode, high=0),
            Metric(f"fuzzed {what}: tests passed", int(found[1]) if found else 0, low=1),
        ]
    return metrics


if __name__ == "__main__":
    raise SystemExit(alone("fuzz", measure, times={"type": int, "default": 20}))
