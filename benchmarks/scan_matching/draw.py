"""The figures: NEES of matchers and covariances by world; errors over iterations."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from benchmarks.scan_matching.honesty import COVARIANCES, MATCHERS, WORLDS, Row
from jaxslam.results.plot import COLORS, COLUMN, PAGE

MARKS = ("o", "s", "v", "^", "D")
LIMITS = 0.1, 1e3


def nees(rows: Sequence[Row]) -> Figure:
    """NEES over its degrees of freedom, a panel a world; beyond the axis at its end."""
    figure = Figure(figsize=(PAGE, 3.0), layout="constrained")
    axes = figure.subplots(1, len(WORLDS), sharex=True, sharey=True)
    names = list(COVARIANCES)
    for panel, world in zip(axes, WORLDS, strict=True):
        own = [row for row in rows if row.world == world]
        panel.axvspan(own[0].low, own[0].high, color="#bdbdbd", lw=0)
        panel.axvline(1.0, color="#333333", lw=0.6)
        for row in own:
            k = list(MATCHERS).index(row.matcher)
            beyond = not LIMITS[0] < row.nees < LIMITS[1]
            panel.plot(
                np.clip(row.nees, LIMITS[0] * 1.15, LIMITS[1] / 1.15),
                names.index(row.way) + 0.16 * (k - 2),
                MARKS[k],
                color=COLORS[k],
                ms=4,
                mfc="white" if beyond else COLORS[k],
                label=row.matcher if row.way == "hessian" else None,
            )
        panel.set(xscale="log", xlim=LIMITS)
        panel.set_title(world, fontsize=9)
        panel.set_yticks(range(len(names)), names)
        panel.tick_params(labelsize=8)
        panel.grid(axis="x", color="#dddddd", lw=0.5)
        for side in ("top", "right"):
            panel.spines[side].set_visible(False)
    axes[0].invert_yaxis()
    figure.supxlabel("NEES over degrees of freedom (1: honest); open marks lie beyond", fontsize=8)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=5, fontsize=8, frameon=False)
    return figure


def convergence(errors: dict[str, np.ndarray]) -> Figure:
    """The distance from the limit over iterations."""
    figure = Figure(figsize=(COLUMN, 2.4), layout="constrained")
    axes = figure.subplots()
    for k, (name, error) in enumerate(errors.items()):
        shown = np.where(error > 0, error, np.nan)
        label = {"point_to_point": "ICP", "point_to_line": "PL-ICP"}[name]
        axes.semilogy(shown, marker=MARKS[k], color=COLORS[k], ms=3, lw=1, label=label)
    axes.set_xlabel("iteration", fontsize=8)
    axes.set_ylabel("distance from the limit [m]", fontsize=8)
    axes.tick_params(labelsize=8)
    axes.grid(color="#dddddd", lw=0.5)
    axes.legend(fontsize=8, frameon=False)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    return figure


def save(figure: Figure, name: str) -> None:
    figure.savefig(Path(__file__).parents[1] / "figures" / f"{name}.png", dpi=200)
