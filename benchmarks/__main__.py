"""All benchmarks, one gate: `python -m benchmarks [--quick]`, or `make bench`.

A table of every metric with the range it must lie in; the exit status is 1 if one is missed. Each
part is also a program of its own: consistency, victoria_park, real_data, speed, gradient,
association, baselines, bearing, delayed, plaza, team, smoothing, fastslam, plain_particles,
scaling, comparison, monte_carlo_localization, seif.
"""

import argparse
import subprocess
import sys
import tempfile
import time

import jax

from benchmarks import (
    baselines,
    bearing,
    comparison,
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


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks")
    parser.add_argument("--quick", action="store_true", help="circle with 200 runs, not 1000")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    metrics = command_seconds()
    metrics += gated(measure_speed(options.quick))
    metrics += gradient.measure()
    metrics += circle.measure(200 if options.quick else 1000)[1]
    metrics += victoria_park.measure()
    metrics += real_data.measure()
    metrics += measure_association(options.quick)
    metrics += baselines.measure(100 if options.quick else 1000)
    metrics += bearing.measure(20 if options.quick else 100)
    metrics += team.measure()
    metrics += delayed.measure(20 if options.quick else 100)
    metrics += plaza.measure()
    metrics += smoothing.measure(10 if options.quick else 100)
    metrics += fastslam.measure(4 if options.quick else 20, (10, 100))
    metrics += plain_particles.measure(8 if options.quick else 20)
    metrics += scaling.measure()
    metrics += seif.measure(4 if options.quick else 10)
    metrics += comparison.measure(8 if options.quick else 16)
    metrics += monte_carlo_localization.measure(4 if options.quick else 12)
    print()
    return report(metrics)


if __name__ == "__main__":
    raise SystemExit(main())
