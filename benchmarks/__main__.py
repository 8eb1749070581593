"""All benchmarks, one gate: `make bench`.

    python -m benchmarks [--quick] [--only NAME,…] [--record]

A table of every metric with the range it must lie in; the exit status is 1 if one is missed.
`--record` writes records/NAME.json and RESULTS.md. A benchmark is a function (quick) -> metrics,
which prints its tables and, unless it is quick, draws its figures.
"""

import argparse
import importlib
import time
from collections.abc import Callable

import jax

from benchmarks.gate import Metric, report
from benchmarks.results import measured
from jaxslam.core._optional import first_line

BENCHMARKS = {
    "commands": "commands",
    "compile": "compile",
    "speed": "speed.benchmark",
    "accelerator": "accelerator",
    "engines": "engines",
    "gradient": "gradient",
    "film": "film",
    "verdict": "verdict",
    "recordings": "recordings",
    "precision": "precision",
    "campaigns": "campaigns",
    "circle": "published:circle",
    "loop": "loop",
    "webmap": "published:webmap",
    "stationary": "published:stationary",
    "victoria_park": "victoria_park",
    "real_data": "real_data",
    "mrclam": "mrclam.benchmark",
    "woods": "woods",
    "twins": "twins",
    "learned_noise": "mrclam.learned",
    "association": "association.benchmark",
    "baselines": "baselines",
    "bearing": "bearing",
    "iterations": "iterations",
    "team": "team",
    "delayed": "delayed",
    "plaza": "plaza",
    "smoothing": "smoothing",
    "graph_files": "graphs.files",
    "graph_draws": "graphs.draws",
    "graph_kernels": "graphs.kernels",
    "graph_filters": "graphs.filters",
    "graph_bicocca": "graphs.bicocca",
    "false_loops": "graphs.false_loops",
    "graph_speed": "graphs.speed",
    "graph_crossover": "graphs.crossover",
    "alternatives": "alternatives",
    "judge": "judge",
    "fastslam": "fastslam",
    "plain_particles": "plain_particles",
    "grids": "grids.benchmark",
    "grid_localization": "grid_localization",
    "laser_slam": "laser_slam.benchmark",
    "scan_matching": "scan_matching.benchmark",
    "lines": "lines",
    "scaling": "scaling",
    "births": "births",
    "honesty": "honesty",
    "seif": "seif",
    "comparison": "campaigns:comparison",
    "monte_carlo_localization": "monte_carlo_localization",
}
"""Name: module, and function if it is not `measure`."""

ON_REQUEST = {
    "graph_draws_thousand": "graphs.draws:thousand",
    "laser_slam_logs": "laser_slam.logs",
    "mrclam_fit": "mrclam.fit",
    "seif_park": "seif:park",
    "linearity": "bearing:linearity",
}
"""Those that take hours, parts of others and a figure: they run only if they are named."""


def benchmark(name: str) -> Callable[[bool], list[Metric]]:
    """The function (quick) -> metrics of a benchmark."""
    module, _, function = (BENCHMARKS | ON_REQUEST)[name].partition(":")
    found: Callable[[bool], list[Metric]] = getattr(
        importlib.import_module(f"benchmarks.{module}"), function or "measure"
    )
    return found


def main() -> int:
    """Run the benchmarks that the command line names, or all."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer runs, no figures")
    parser.add_argument("--only", default="", help="names of benchmarks, separated by commas")
    parser.add_argument("--record", action="store_true", help="write records and RESULTS.md")
    options = parser.parse_args()
    known = [*BENCHMARKS, *ON_REQUEST]
    wanted = [name for name in options.only.split(",") if name] or list(BENCHMARKS)
    if unknown := sorted(set(wanted) - set(known)):
        parser.error(f"no benchmark {', '.join(unknown)}; there are {', '.join(known)}")
    jax.config.update("jax_enable_x64", True)
    metrics: list[Metric] = []
    for name in wanted:
        print(f"\n{name}", flush=True)
        began = time.perf_counter()
        try:
            measure = benchmark(name)
        except Exception as error:  # of GTSAM and others, where they are missing or broken
            raise SystemExit(f"{name}: {first_line(error)}: pip install --group bench") from error
        found = measured(name, measure, options.quick) if options.record else measure(options.quick)
        # What was measured stays on the screen, whatever becomes of the parts after it.
        if found:
            report(found)
        print(f"{name}: {time.perf_counter() - began:.0f} s", flush=True)
        metrics += found
    print("\nall")
    return report(metrics) if metrics else 0


if __name__ == "__main__":
    raise SystemExit(main())
