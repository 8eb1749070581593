"""Campaigns of `cloister` on a GPU and on all cores of the CPU beside it; left out without a GPU.

Runs a second after the first block, which compiles, and those of the filter without draws and
scores, in float64 and float32; and how far the pose NEES differ between the two, run by run.
"""

import os
import subprocess
import sys

import numpy as np

from benchmarks.gate import Metric, child, table

MEASURE = """
import json, os, sys, time
import jax, numpy as np
platform, dtype, name, runs = *sys.argv[1:4], int(sys.argv[4])
if platform == "cpu":
    jax.config.update("jax_num_cpu_devices", len(os.sched_getaffinity(0)))
jax.config.update("jax_platforms", platform)
jax.config.update("jax_enable_x64", dtype == "float64")
from jaxslam import catalog, monte_carlo, scenarios
world = scenarios.cloister()
marks = [(time.perf_counter(), 0)]
campaign = monte_carlo(
    world, {name: catalog.ALL[name](world)}, runs, jax.random.key(0),
    devices=jax.devices(), block=None if platform == "cpu" else runs // 3,
    progress=lambda done, total: marks.append((time.perf_counter(), done)),
)
blocks = [mark for mark in marks if mark[1]]
rate = (blocks[-1][1] - blocks[0][1]) / (blocks[-1][0] - blocks[0][0])
alone = len(jax.devices()) / (campaign.step_seconds[name] * campaign.steps)
nees = np.asarray(campaign.filters[name].per_run["nees_pose"]).tolist()
first = blocks[0][0] - marks[0][0]
print(json.dumps([rate, alone, first, jax.devices()[0].device_kind, nees]))
"""
RUNS = 12288
SHARES = {"ekf": 1, "right_invariant": 1, "fastslam2": 4}
"""The filters, and by what their number of runs is divided; the cores do a quarter of the GPU's."""


def campaign(platform, dtype, name, runs):
    """Runs a second, those of the filter alone, seconds until the first block, device, pose NEES of
    each run."""
    return child("-c", MEASURE, platform, dtype, name, runs)


def measure(quick: bool = False) -> list[Metric]:
    """Rates by filter, precision and device."""
    gpu = [sys.executable, "-c", "import jax; jax.devices('cuda')"]
    if subprocess.run(gpu, stderr=subprocess.DEVNULL).returncode:
        print("no GPU", file=sys.stderr)
        return []
    metrics, rows, kind = [], [], ""
    for dtype in ("float64", "float32"):
        for name, share in SHARES.items():
            *gpu, kind, nees = campaign("cuda", dtype, name, RUNS // share)
            *cpu, _, nees_cpu = campaign("cpu", dtype, name, max(RUNS // share // 4, 256))
            nees, nees_cpu = np.array(nees[: len(nees_cpu)]), np.array(nees_cpu)
            pairs = [*zip(gpu, cpu, strict=True), (nees.mean(), nees_cpu.mean())]
            rows.append([name, dtype, *(f"{a:.4g}, {b:.4g}" for a, b in pairs)])
            metrics.append(Metric(f"{name}, {dtype}, GPU / all cores", gpu[0] / cpu[0]))
            off = np.abs(nees / nees_cpu - 1)
            note = f"median; at most {off.max():.2g}"
            what = f"{name}, {dtype}, NEES of a run, GPU / CPU - 1"
            metrics.append(Metric(what, float(np.median(off)), note=note))
    print(f"\n{kind}, {len(os.sched_getaffinity(0))} cores beside it; {RUNS} runs of `cloister`\n")
    print("In a cell: the GPU, the cores.\n")
    header = ["filter", "precision", "runs/s", "filter alone [runs/s]", "first block [s]"]
    print(table([*header, "mean pose NEES"], rows))
    return metrics
