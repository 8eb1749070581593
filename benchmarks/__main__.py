"""All benchmarks, one gate: `make bench`.

    python -m benchmarks [--quick] [--only NAME,…] [--record]

A table of every metric with the range it must lie in; the exit status is 1 if one is missed.
`--record` writes records/NAME.json and RESULTS.md. Most parts are also a program of their own, with
options.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax

from benchmarks import (
    accelerator,
    baselines,
    bearing,
    campaigns,
    comparison,
    compile,
    delayed,
    false_loops,
    fastslam,
    film,
    fuzz,
    gradient,
    graph_files,
    graph_speed,
    grid_localization,
    kill,
    lines,
    monte_carlo_localization,
    plain_particles,
    plaza,
    real_data,
    scaling,
    seif,
    smoothing,
    soak,
    team,
    verdict,
    victoria_park,
    wheel,
)
from benchmarks.association.__main__ import measure as measure_association
from benchmarks.consistency import circle, loop, stationary, webmap
from benchmarks.gate import Metric, report
from benchmarks.graphs.__main__ import measure as measure_graphs
from benchmarks.grids.__main__ import measure as measure_grids
from benchmarks.laser_slam.__main__ import measure as measure_laser_slam
from benchmarks.mrclam.__main__ import measure as measure_mrclam
from benchmarks.results import measured
from benchmarks.scan_matching.__main__ import measure as measure_matching
from benchmarks.speed.__main__ import gated
from benchmarks.speed.__main__ import measure as measure_speed
from jaxslam.results.plot.style import png

FIGURES = Path(__file__).parent / "figures"
SOAKED = Path(__file__).parents[1] / ".cache" / "soak"
"""Where the long campaign goes on from, if it was interrupted."""
LONG = ("graph_draws_thousand", "soak_million")
"""Benchmarks of hours, which run where they are named."""


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
    """What is measured, by name, in order; figures are drawn unless it is quick."""

    def drawn(name: str) -> Path | None:
        return None if quick else FIGURES / name

    return {
        "commands": command_seconds,
        "compile": compile.measure,
        "speed": lambda: gated(measure_speed(quick)),
        "accelerator": accelerator.measure,
        "gradient": lambda: gradient.measure() + gradient.measure("sequential"),
        "film": film.measure,
        "verdict": lambda: verdict.measure(1000 if quick else 4000),
        "campaigns": lambda: campaigns.measure(10 if quick else 100),
        "circle": lambda: circle_published(200 if quick else 1000),
        "loop": lambda: pictured(loop, maps=10 if quick else 100),
        "webmap": lambda: pictured(webmap, runs=10 if quick else 100),
        "stationary": lambda: pictured(stationary, runs=20 if quick else 200),
        "victoria_park": lambda: victoria_park.measure(out=drawn("victoria_park.png")),
        "real_data": real_data.measure,
        "mrclam": measure_mrclam,
        "association": lambda: measure_association(quick, drawn("")),
        "baselines": lambda: baselines.measure(100 if quick else 1000),
        "bearing": lambda: bearing.measure(20 if quick else 100),
        "team": lambda: team.measure(out=drawn("team.png")),
        "delayed": lambda: delayed.measure(20 if quick else 100),
        "plaza": lambda: plaza.measure(figure=not quick),
        "smoothing": lambda: smoothing.measure(10 if quick else 100),
        "graph_files": graph_files.measure,
        "graph_draws": lambda: measure_graphs(quick, ["draws"]),
        "graph_kernels": lambda: measure_graphs(quick, ["kernels"]),
        "graph_filters": lambda: measure_graphs(quick, ["filters"]),
        "graph_bicocca": lambda: measure_graphs(quick, ["bicocca"]),
        "false_loops": lambda: false_loops.measure(quick),
        "graph_speed": lambda: graph_speed.measure(3 if quick else 9),
        "fastslam": lambda: fastslam.measure(
            4 if quick else 20, (10, 100), drawn("fastslam_nees.png")
        ),
        "plain_particles": lambda: plain_particles.measure(8 if quick else 20),
        "grids": measure_grids,
        "grid_localization": lambda: grid_localization.measure(10 if quick else 100),
        "laser_slam": lambda: measure_laser_slam(quick),
        "scan_matching": lambda: measure_matching(quick),
        "lines": lambda: lines.measure(10 if quick else 100),
        "scaling": lambda: scaling.measure(drawn("scaling.png")),
        "seif": lambda: seif.measure(4 if quick else 10) + seif.park(),
        "comparison": lambda: comparison.measure(8 if quick else 16, out=drawn("comparison.png")),
        "soak": lambda: soak.measure(6_000 if quick else 20_000),
        "kill": lambda: kill.measure(10 if quick else 100),
        "fuzz": lambda: fuzz.measure(2 if quick else 20),
        "wheel": wheel.measure,
        "monte_carlo_localization": lambda: monte_carlo_localization.measure(
            4 if quick else 12, out=drawn("monte_carlo_localization.png")
        ),
        "graph_draws_thousand": lambda: measure_graphs(quick, ["draws"], 1000),
        "soak_million": lambda: soak.measure(1_000_000, folder=str(SOAKED)),
    }


def pictured(module: Any, **scale: int) -> list[Metric]:
    """A published experiment: its section is printed, its figure drawn."""
    section, metrics, figure = module.measure(**scale)
    print(section, flush=True)
    (FIGURES / f"{section.name}.png").write_bytes(png(figure))
    return metrics


def circle_published(runs: int) -> list[Metric]:
    """UKF-M's published figures beside ours."""
    section, metrics = circle.measure(runs)
    print(section, flush=True)
    return metrics


def main(names: Sequence[str] = ()) -> int:
    """Run the benchmarks of these names, or those that the command line names, or all."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer runs, no campaigns of cloister")
    parser.add_argument("--only", default="", help="names of benchmarks, separated by commas")
    parser.add_argument("--record", action="store_true", help="write records and RESULTS.md")
    options = parser.parse_args()
    known = parts(options.quick)
    wanted = (
        [name for name in options.only.split(",") if name]
        or names
        or [name for name in known if name not in LONG]
    )
    if unknown := sorted(set(wanted) - set(known)):
        parser.error(f"no benchmark {', '.join(unknown)}; there are {', '.join(known)}")
    jax.config.update("jax_enable_x64", True)
    metrics: list[Metric] = []
    for name in wanted:
        print(f"\n{name}", flush=True)
        began = time.perf_counter()
        if options.record:
            command = f"python -m benchmarks --record {'--quick ' * options.quick}--only {name}"
            found = measured(name, known[name], command)
        else:
            found = known[name]()
        # What was measured stays on the screen, whatever becomes of the parts after it.
        if found:
            report(found)
        print(f"{name}: {time.perf_counter() - began:.0f} s", flush=True)
        metrics += found
    print("\nall")
    return report(metrics) if metrics else 0


if __name__ == "__main__":
    raise SystemExit(main())
