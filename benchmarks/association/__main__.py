"""`python -m benchmarks.association [--quick] [--out FOLDER]`: association methods compared.

One scan as the heading becomes uncertain; whole runs against clutter and odometry noise; the cost
beside a correction, and of compiling; Victoria Park without its identities. --quick, some five
minutes, leaves the whole runs out, which take some 15 more.
"""

import argparse
from pathlib import Path

import jax
import numpy as np

from benchmarks.association import closing, clutter, cost, heading, park
from benchmarks.gate import Metric, report
from jaxslam.results.plot.style import png


def table(title, rows, columns):
    """rows: {name: {column: value}}."""
    print(f"\n{title}\n{'':24}" + "".join(f"{column:>20}" for column in columns))
    for name, values in rows.items():
        cells = (f"{values[c]:20.4g}" if c in values else f"{'-':>20}" for c in columns)
        print(f"{name:24}" + "".join(cells))


def measure(quick=False, out=None):
    metrics = []

    def save(figure, name):
        if out:
            out.mkdir(parents=True, exist_ok=True)
            (out / f"association_{name}").write_bytes(png(figure))

    seconds = cost.measure()
    print("\n20 measurements, 200 landmarks, 16 runs together, time a run:")
    for name, value in seconds.items():
        print(f"{name:24}{1e6 * value:10.0f} µs{value / seconds['correction']:8.2f} × correction")
        if name not in ("correction", "joint"):
            ratio = value / seconds["correction"]
            metrics.append(Metric(f"association, {name} / correction", ratio, high=2.0))

    print("\nthe whole pipeline, 20 measurements, 200 landmarks, life and merging, compiled in:")
    for name, value in cost.compile_seconds().items():
        print(f"{name:24}{value:10.1f} s")
        high = np.inf if "gradient" in name else 20.0  # nothing was asked of the gradient
        metrics.append(Metric(f"compile time, {name} [s]", value, high=high))

    found = heading.measure()
    save(heading.draw(found), "heading.png")
    rows = {
        f"σ = {sigma:g}°": {name: right[i] for name, (right, _, _) in found.items()}
        for i, sigma in enumerate(heading.SIGMAS)
    }
    table("share associated rightly", rows, tuple(found))
    budget = found["joint"][2].max()
    print(f"joint: at most {budget:.1%} of the searches at one σ ended at their budget")

    rows, taken, maps = park.measure()
    save(park.draw(maps), "victoria_park.png")
    print("\nVictoria Park, identities ignored, against identities given:")
    print(f"{'':20}" + "".join(f"{name:>20}" for name in rows))
    for name in rows[taken]:
        print(f"{name:20}" + "".join(f"{row[name]:20.4g}" for row in rows.values()))
    figures = rows[taken]
    print(f"taken, for the fewest landmarks: {taken}")
    wrong = max(figures["wrong [%]"], figures["by birth [%]"])
    metrics.append(Metric("Victoria Park, wrong associations [%]", wrong, high=5.0))
    metrics.append(Metric("Victoria Park, map from known [m]", figures["map RMSE [m]"], high=1.0))

    if not quick:
        settings = {(c, 1.0) for c in clutter.CLUTTER} | {(1.0, n) for n in clutter.NOISE}
        runs = {at: clutter.measure(*at) for at in sorted(settings)}
        for (density, noise), rows in runs.items():
            title = f"clutter {density:g} a scan, odometry {noise:g} ×, {clutter.RUNS} runs"
            table(title, rows, (*clutter.ROWS, "divergent"))
        save(clutter.draw(runs), "clutter.png")
        rows, pictures = closing.measure()
        table(f"a long loop, {closing.RUNS} runs", rows, closing.COLUMNS)
        save(closing.draw(pictures, closing.SHOWN), "closing.png")
        found, wrong = (rows["cluster"][column] for column in closing.COLUMNS[:2])
        metrics.append(Metric("long loop, first landmarks found again [%]", found, low=75.0))
        metrics.append(Metric("long loop, wrong associations after it [%]", wrong, high=1.0))
    return metrics


def main():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.association")
    parser.add_argument("--quick", action="store_true", help="without the whole runs")
    parser.add_argument("--out", type=Path, help="write figures to this folder")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    metrics = measure(options.quick, options.out)
    print()
    return report(metrics)


if __name__ == "__main__":
    raise SystemExit(main())
