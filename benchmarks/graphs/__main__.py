"""Is a graph honest about its own covariance?

    python -m benchmarks.graphs [--quick] [--part draws,…] [--runs 40]

- `draws`: many draws of the Manhattan world at its true poses (with --quick, or without the data, a
  square of 100 poses), noise as the file has it, times 1, 3 and 10 (`monte_carlo`);
- `kernels`: robust kernels at 0 to 50 % false loop closures (`kernels`);
- `filters`: filters, the fixed-lag smoother and the graph on the same draws of `circle`, `loop` and
  `webmap` (`filters`);
- `bicocca`: robust kernels and GTSAM's graduated non-convexity on a real path (`bicocca`).

Figures: benchmarks/figures/graph_draws.png, graph_kernels.png, graph_filters_*.png.
"""

import argparse

import jax

from benchmarks.gate import Metric, report
from benchmarks.graphs import bicocca, figures, kernels
from benchmarks.graphs.filters import campaigns
from benchmarks.graphs.monte_carlo import SCALES, draws, summary
from benchmarks.graphs.worlds import MANHATTAN, manhattan, ring

PARTS = ("draws", "kernels", "filters", "bicocca")


def measure(quick=False, parts=PARTS, runs=40):
    """The metrics of the chosen parts, which print their tables and draw their figures; runs: of
    the Manhattan world."""
    there = MANHATTAN.exists() and not quick
    metrics = []
    if "draws" in parts:
        metrics += _draws(manhattan() if there else ring(), runs if there else 100)
    if "kernels" in parts:
        metrics += _kernels(ring() if quick else ring(200, 40), 4 if quick else 20)
    if "filters" in parts:
        metrics += _filters(10 if quick else 20, 100 if quick else None)
    if "bicocca" in parts and bicocca.GRAPH.exists() and not quick:
        metrics += _bicocca()
    return metrics


def _draws(graph, runs):
    table = graph.tables["relative_pose"]
    dof = 3 * len(table.who) - 3 * (len(graph.poses) - 1)
    name = f"{len(graph.poses)} poses"
    print(f"\n{runs} draws of {name}, {len(table.who)} relative poses, {dof} degrees of freedom")
    found = {scale: draws(graph, scale, runs, block=8) for scale in SCALES}
    rows = {scale: summary(each, dof) for scale, each in found.items()}
    _table(rows, "noise ×")
    figures.draws(found, dof)
    first = rows[SCALES[0]]
    half = first["its 95 % interval ±"]
    return [
        Metric(f"{name}: pose NEES, noise × 1", first["pose NEES"], 3 - 2 * half, 3 + 2 * half),
        Metric(f"{name}: χ² / dof, noise × 1", first["χ² / dof"], 0.99, 1.01),
        Metric(f"{name}: RMSE / bound, noise × 1", first["RMSE / bound"], 0.8, 1.2),
        *(
            Metric(
                f"{name}: certificate fails, noise × {scale:g}", rows[scale]["certificate fails"]
            )
            for scale in SCALES[1:]
        ),
        Metric(f"{name}: not converged", first["not converged"], high=0.0),
    ]


def _kernels(graph, runs):
    names = ("none", *kernels.ROBUST)
    found = kernels.compare(graph, names, runs)
    print(f"\n{runs} runs of {len(graph.poses)} poses: robust kernels and false closures")
    for name in names:
        rows = {share: found[name, share] for share in kernels.SHARES}
        _table(rows, f"{name}, false")
    figures.kernels(found, names)
    worst = max(kernels.SHARES)
    return [
        Metric(
            f"{name}: position RMSE at {worst:.0%} false / none at 0 %",
            found[name, worst]["position RMSE [m]"] / found["none", 0.0]["position RMSE [m]"],
        )
        for name in names
    ]


def _filters(runs, steps):
    metrics = []
    for name, campaign in campaigns(runs, steps).items():
        print(f"\n{campaign}")
        figures.filters(name, campaign)
        nees = {each: s.measures["nees_pose"].value for each, s in campaign.filters.items()}
        metrics += [Metric(f"{name}: pose NEES, {each}", value) for each, value in nees.items()]
        metrics.append(
            Metric(
                f"{name}: NEES, fixed lag with / without first estimates",
                nees["fixed_lag_fej"] / nees["fixed_lag"],
                high=1.05,
            )
        )
    return metrics


def _bicocca():
    metrics = []
    for share in (0.0, 0.5):
        found = bicocca.compare(share)
        _table(found, "")
        ours, theirs = found["truncated"], found["GTSAM's GNC"]
        gap = ours["position RMSE [m]"] / theirs["position RMSE [m]"]
        name = f"Bicocca 25b, {share:.0%} false"
        metrics.append(Metric(f"{name}: position RMSE, truncated / GTSAM's GNC", gap, high=1.05))
        if share:
            metrics.append(Metric(f"{name}: false loops kept", ours["false loops kept"]))
    return metrics


def _table(rows, head):
    """Print figures of merit, a column for each row of {label: {name: value}}."""
    names = list(next(iter(rows.values())))
    width = max(map(len, [*names, head]))
    print(f"{head:{width}}" + "".join(f"{label!s:>12}" for label in rows))
    for name in names:
        print(f"{name:{width}}" + "".join(f"{row[name]:>12.4g}" for row in rows.values()))


def main():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.graphs")
    parser.add_argument("--quick", action="store_true", help="a small graph and few runs")
    parser.add_argument("--part", default=",".join(PARTS), help="some of " + ", ".join(PARTS))
    parser.add_argument("--runs", type=int, default=40, help="draws of the Manhattan world")
    options = parser.parse_args()
    asked = options.part.split(",")
    if unknown := set(asked) - set(PARTS):
        parser.error(f"--part: expected some of {', '.join(PARTS)}, got {', '.join(unknown)}")
    jax.config.update("jax_enable_x64", True)
    metrics = measure(options.quick, asked, options.runs)
    print()
    return report(metrics)


if __name__ == "__main__":
    raise SystemExit(main())
