"""Estimators of other people on the same draws as ours: what their covariances are worth.

`circle` and `loop`, `jaxslam draws` and `jaxslam judge`: an EKF-SLAM in C++, in Octave and with
filterpy, which should be ours to rounding, and GTSAM's ISAM2 and batch optimum, all of
`examples/judge`, beside the EKF and the right-invariant EKF of the library. ISAM2 has its default
parameters. The batch is of the smoothed path, which no filter can reach; its NEES is that of all
poses given the whole run. GTSAM's programs write no innovations, hence have no NIS.

The gates: the EKFs of others have our EKF's verdict, and its pose NEES in each run to 1e-6; no run
of any of them is lost. A program that is absent is left out, and said to be.
"""

import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

import jax
import numpy as np

from benchmarks.gate import Metric, show
from jaxslam._cli.campaigns.estimator_runs import Programs
from jaxslam.catalog import FILTERS
from jaxslam.consistency import write_draws
from jaxslam.consistency.campaign._judging import judge_sources
from jaxslam.datasets._judged_folders import folder_source, read_draws
from jaxslam.simulation import scenarios

EXAMPLES = Path(__file__).parents[1] / "examples" / "judge"
EKFS = ("C++", "Octave", "filterpy")
OURS = ("ekf", "right_invariant")
TOL = 1e-6


def commands(folder: Path) -> dict[str, list[str]]:
    """The words of each program that is there, before RUN and ESTIMATE; what is absent is printed.

    folder: where the program in C++ is compiled.
    """
    words = {}
    compiler = shutil.which("c++") or shutil.which("g++")
    if compiler:
        binary = folder / "ekf_slam"
        source = EXAMPLES / "ekf_slam.cpp"
        subprocess.run([compiler, "-std=c++17", "-O2", "-o", binary, source], check=True)
        words["C++"] = [str(binary)]
    if octave := shutil.which("octave-cli"):
        words["Octave"] = [octave, "--norc", "-q", str(EXAMPLES / "ekf_slam.m")]
    if find_spec("filterpy"):
        words["filterpy"] = [sys.executable, str(EXAMPLES / "filterpy_ekf.py")]
    if find_spec("gtsam"):
        words["ISAM2"] = [sys.executable, str(EXAMPLES / "gtsam_slam.py")]
        words["batch"] = [*words["ISAM2"], "--batch"]
    for name in ("C++", "Octave", "filterpy", "ISAM2", "batch"):
        if name not in words:
            print(f"{name} is not installed: left out")
    return words


def judged(world, runs: int, folder: Path, programs: dict[str, list[str]]):
    """The campaign of all programs, on all cores, and of our filters on the same draws."""
    write_draws(world, runs, jax.random.key(0), folder / "draws")
    draws = read_draws(folder / "draws")
    sources = {}
    for name, words in programs.items():
        command = f"{shlex.join(words)} {{run}} {{estimate}}"
        estimates = folder / name
        cores = os.cpu_count() or 1
        faults = Programs(command, draws.path, estimates, None).run(range(runs), cores)
        sources[name] = folder_source(estimates, draws, world.sensor.measurements, 1, faults)
    filters = {name: FILTERS[name](world) for name in OURS}
    return judge_sources(world, sources, runs, draws.key, filters=filters)


def measure(quick: bool = False) -> list[Metric]:
    metrics: list[Metric] = []
    runs, steps = (4, 100) if quick else (50, 2500)
    for make in (scenarios.circle, scenarios.loop):
        world = make(steps)
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            campaign = judged(world, runs, folder, commands(folder))
        print(campaign, flush=True)
        rows, ours = {}, campaign.filters["ekf"]
        for name, summary in campaign.filters.items():
            averages = summary.measures
            rows[name] = {"verdict": summary.verdict}
            for row in ("nees_pose", "nis_per_dof", "rmse_position", "rmse_heading_deg"):
                if row in averages:
                    rows[name][row] = averages[row].value
                    metrics.append(Metric(f"{world.name}, {name}: {row}", averages[row].value))
            if seconds := campaign.run_seconds.get(name):
                rows[name]["seconds a run"] = seconds
                metrics.append(Metric(f"{world.name}, {name}: seconds a run", seconds))
            lost = len(summary.not_finite_runs)
            metrics.append(Metric(f"{world.name}, {name}: runs not judged", lost, high=0))
            if name in EKFS:
                gap = np.abs(summary.per_run["nees_pose"] - ours.per_run["nees_pose"]).max()
                is_same = summary.verdict == ours.verdict and summary.by == ours.by
                metrics += [
                    Metric(f"{world.name}, {name}: NEES of a run less our EKF's", gap, high=TOL),
                    Metric(f"{world.name}, {name}: the verdict is our EKF's", is_same, low=1),
                ]
        show(f"{world.name}, {steps} steps, {runs} runs", rows)
    return metrics
