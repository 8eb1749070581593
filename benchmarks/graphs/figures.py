"""The figures of the benchmark."""

from pathlib import Path

import numpy as np
import scipy.stats

from benchmarks.graphs import kernels as robust
from jaxslam import plot
from jaxslam.results.plot.style import INK, PAGE, caption, curve, every_handle, panels_of, titled

FIGURES = Path(__file__).parents[1] / "figures"


def draws(found, dof):
    """NEES by pose and distribution of the χ² of the optimum, for each noise."""
    figure, panels = panels_of(PAGE, 2.6, 1, 3, share=(False, False))
    nees, ordered, cost = panels
    for i, (scale, each) in enumerate(found.items()):
        good = ~each.failed
        if good.sum() < 2:
            continue
        name = f"noise × {scale:g}"
        pose = np.arange(1, each.nees.shape[1] + 1)
        curve(nees, i, pose, each.nees[good].mean(axis=0), name)
        level = np.linspace(0.01, 0.99, 99)
        values = np.quantile(each.nees[good], level)
        curve(ordered, i, level, scipy.stats.chi2(3).cdf(values), name)
        ratio = np.sort(each.chi2[good]) / dof
        curve(cost, i, ratio, (np.arange(len(ratio)) + 0.5) / len(ratio), name)
    nees.axhline(3, color=INK, lw=0.8, zorder=1.5)
    nees.set_ylim(bottom=0)
    nees.set_xlabel("pose")
    titled(nees, "pose NEES (dof 3)")
    ordered.plot([0, 1], [0, 1], color=INK, lw=0.8, label="honest")
    ordered.set_xlabel("share of the poses")
    titled(ordered, "probability of their region")
    x = np.linspace(*cost.get_xlim(), 200)
    cost.plot(x, scipy.stats.chi2(dof).cdf(x * dof), color=INK, lw=0.8, label="honest")
    cost.set_xlabel("χ² of the optimum / dof")
    titled(cost, "share of the draws below")
    count = len(next(iter(found.values())).chi2)
    caption(figure, f"{count} draws of one graph", every_handle(panels))
    (FIGURES / "graph_draws.png").write_bytes(plot.png(figure))


def kernels(found, names):
    """Error, NEES, coverage and false closures kept, against the share of false closures."""
    shown = {
        "position RMSE [m]": "log",
        "pose NEES": "log",
        "poses within 95 %": "linear",
        "false closures kept": "linear",
    }
    figure, panels = panels_of(PAGE, 4.2, 2, 2)
    share = 100 * np.array(robust.SHARES)
    for axes, (key, scale) in zip(panels, shown.items(), strict=True):
        for i, name in enumerate(names):
            y = np.array([found[name, part][key] for part in robust.SHARES])
            curve(axes, i, share, y, name)
        axes.set_yscale(scale)
        titled(axes, key)
    panels[1].axhline(3, color=INK, lw=0.8, zorder=1.5)
    panels[2].axhline(0.95, color=INK, lw=0.8, zorder=1.5)
    for axes in panels[2:]:
        axes.set_xlabel("false loop closures [%]")
    caption(figure, "Robust kernels on the loop closures; lines: honest")
    (FIGURES / "graph_kernels.png").write_bytes(plot.png(figure))


def filters(name, campaign):
    """NEES of filters, the fixed-lag smoother and the graph."""
    figure = plot.nees_figure(campaign, blocks=("pose", "heading"))
    (FIGURES / f"graph_filters_{name}.png").write_bytes(plot.png(figure))
