"""Speed of the `cloister` workload beside a hand-written limit: `python -m benchmarks.speed`.

36 landmarks, 200 steps, about 6,500 rank-2 updates of a 75×75 covariance a run. The limit is a C++
program outside this repository (one thread, fixed arrays); give its path in JAXSLAM_LIMIT, or have
it at ../shared/limits/ekf_limit.cpp. Both run here, one after the other; only the ratio matters.
"""

import os
import subprocess
import tempfile
import time
from functools import partial
from pathlib import Path

import jax

from benchmarks.gate import Metric, report
from jaxslam.family import FILTERS
from jaxslam.run import run
from jaxslam.scenarios import cloister
from jaxslam.simulate import simulate

RUNS = 64


def measure() -> list[Metric]:
    ours = _seconds_a_run()
    metrics = [Metric("cloister, seconds a run, all cores", ours, note=f"vmap of {RUNS}, float64")]
    limit = _limit_seconds_a_run()
    if limit is None:
        print("cloister: no limit program or no C++ compiler; set JAXSLAM_LIMIT")
    else:
        metrics.append(Metric("cloister, C++ limit, seconds a run, one core", limit))
        metrics.append(Metric("cloister, ours / limit", ours / limit))
    return metrics


def _seconds_a_run() -> float:
    scenario = cloister()
    ekf = FILTERS["ekf"](scenario)
    keys = jax.random.split(jax.random.key(0), RUNS)
    _, logs = jax.jit(jax.vmap(partial(simulate, scenario)))(keys)

    def final_pose(log, key):
        return run(ekf, log, scenario.pose, scenario.pose_cov, key).estimate.pose[-1]

    go = jax.jit(jax.vmap(final_pose)).lower(logs, keys).compile()
    jax.block_until_ready(go(logs, keys))
    best = min(_timed(lambda: jax.block_until_ready(go(logs, keys))) for _ in range(3))
    return best / RUNS


def _limit_seconds_a_run() -> float | None:
    beside = Path(__file__).parents[2] / "shared" / "limits" / "ekf_limit.cpp"
    source = Path(os.environ.get("JAXSLAM_LIMIT", beside))
    if not source.exists():
        return None
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "limit"
        flags = ["-O3", "-march=native", "-ffast-math"]
        try:
            subprocess.run(["g++", *flags, str(source), "-o", str(program)], check=True)
        except (OSError, subprocess.CalledProcessError):
            return None
        best = min(_timed(lambda: subprocess.run([program, "100"], check=True)) for _ in range(3))
    return best / 100


def _timed(action) -> float:
    began = time.perf_counter()
    action()
    return time.perf_counter() - began


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    raise SystemExit(report(measure()))
