"""All benchmarks, one gate: `python -m benchmarks [--quick]`, or `make bench`.

A table of every metric with the range it must lie in; the exit status is 1 if one is missed. Each
part is also a program of its own: compile, consistency, victoria_park, real_data, speed, gradient,
association, baselines, bearing, delayed, plaza, team, smoothing, fastslam, plain_particles,
scaling, comparison, monte_carlo_localization, seif, verdict.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable

import jax

from benchmarks import (
    baselines,
    bearing,
    comparison,
    compile,
    delayed,
    fastslam,
    gradient,
    monte_carlo_localization,
    plain_particles,
    plaza,
    real_data,
    scaling,
    seif,
    smoothing,
    team,
    verdict,
    victoria_park,
)
from benchmarks.association.__main__ import measure as measure_association
from benchmarks.consistency import circle
from benchmarks.gate import Metric, report
from benchmarks.speed.__main__ import gated
from benchmarks.speed.__main__ import measure as measure_speed


def command_seconds() -> list[Metric]:
    """The commands as a user runs them, imports and compilation included."""
    metrics = []
    for name, what in (("consistency", "100 runs"), ("verify", "every model")):
        with tempfile.TemporaryDirectory() as folder:
            began = time.perf_counter()
            subprocess.run([sys.executable, "-m", "jaxslam", name, "--out", folder], check=True)
        seconds = time.perf_counter() - began
        metrics.append(Metric(f"jaxslam {name}, {what} [s]", seconds, high=60.0))
    return metrics


def parts(quick: bool) -> dict[str, Callable[[], list[Metric]]]:
    """What is measured, by name, in order."""
    return {
        "commands": command_seconds,
        "compile": compile.measure,
        "speed": lambda: gated(measure_speed(quick)),
        "gradient": gradient.measure,
        "verdict": lambda: verdict.measure(1000 if quick else 4000),
        "circle": lambda: circle.measure(200 if quick else 1000)[1],
        "victoria_park": victoria_park.measure,
        "real_data": real_data.measure,
        "association": lambda: measure_association(quick),
        "baselines": lambda: baselines.measure(100 if quick else 1000),
        "bearing": lambda: bearing.measure(20 if quick else 100),
        "team": team.measure,
        "delayed": lambda: delayed.measure(20 if quick else 100),
        "plaza": plaza.measure,
        "smoothing": lambda: smoothing.measure(10 if quick else 100),
        "fastslam": lambda: fastslam.measure(4 if quick else 20, (10, 100)),
        "plain_particles": lambda: plain_particles.measure(8 if quick else 20),
        "scaling": scaling.measure,
        "seif": lambda: seif.measure(4 if quick else 10),
        "comparison": lambda: comparison.measure(8 if quick else 16),
        "monte_carlo_localization": lambda: monte_carlo_localization.measure(4 if quick else 12),
    }


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks")
    parser.add_argument("--quick", action="store_true", help="fewer runs, no campaigns of cloister")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    metrics: list[Metric] = []
    for name, measure in parts(options.quick).items():
        print(f"\n{name}", flush=True)
        began = time.perf_counter()
        found = measure()
        # What was measured stays on the screen, whatever becomes of the parts after it.
        if found:
            report(found)
        print(f"{name}: {time.perf_counter() - began:.0f} s", flush=True)
        metrics += found
    print("\nall")
    return report(metrics)


if __name__ == "__main__":
    raise SystemExit(main())
