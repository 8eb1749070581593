"""Figure of the NEES of a campaign's filters over the steps, with the 95 % band."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxslam.catalog import KINDS
from jaxslam.consistency import DOF
from jaxslam.monte_carlo import Campaign
from jaxslam.results.plot.style import (
    INK,
    caption,
    curve,
    head,
    logarithmic,
    panels_of,
    runs_of,
    span,
)

_TOGETHER = 5
"""largest number of curves in a panel"""

_RANGE = (1 / 10, 100.0)
"""range of small panels, in multiples of dof"""


def nees_figure(campaign: Campaign, *, blocks: Sequence[str] = tuple(DOF)) -> Figure:
    """Average NEES over the steps for every filter of a campaign, with the 95 % chi-square band.

    The band is that of the filter with the most finite runs, the narrowest. More than five filters
    are drawn in a row of panels for each kind of filter (`catalog.KINDS`). Their scales are the
    same and end at 100 times dof; larger values are drawn at the upper edge.
    """
    if len(campaign.filters) > _TOGETHER:
        return _by_kind(campaign, blocks)
    figure, panels = panels_of(7.0, 1.9 * len(blocks) + 0.8, len(blocks))
    step = np.arange(1, campaign.steps + 1)
    for axes, block in zip(panels, blocks, strict=True):
        _draw_band(axes, campaign, block)
        for i, (name, summary) in enumerate(campaign.filters.items()):
            label = f"{name} ({summary.verdict})"
            curve(axes, i, step, summary.curves[f"nees_{block}"], label)
        axes.set(ylabel=f"{block} NEES (dof {DOF[block]})")
        logarithmic(axes)
    caption(figure, f"{head(campaign)}: NEES, average over {runs_of(campaign)}")
    panels[-1].set(xlabel="step", xlim=span(campaign.steps))
    return figure


def kinds_of(names: Sequence[str]) -> list[tuple[str, list[str]]]:
    """Groups (kind, names) of at most five filters: those of `catalog.KINDS`, then others."""
    known = {name: kind for kind, members in KINDS.items() for name in members}
    found = []
    for kind in [*KINDS, "others"]:
        mine = [name for name in names if known.get(name, "others") == kind]
        found += [(kind, mine[at : at + _TOGETHER]) for at in range(0, len(mine), _TOGETHER)]
    return found


def _by_kind(campaign: Campaign, blocks: Sequence[str]) -> Figure:
    """The figure with a row of panels for each kind of filter."""
    rows = kinds_of(list(campaign.filters))
    figure = Figure(figsize=(9.4, 1.35 * len(rows) + 0.9), dpi=150, layout="constrained")
    widths = [*[1.0] * len(blocks), 0.02]
    grid = figure.subplots(
        len(rows), len(blocks) + 1, sharex="col", sharey="col", squeeze=False, width_ratios=widths
    )
    step = np.arange(1, campaign.steps + 1)
    for row, (kind, names) in zip(grid, rows, strict=True):
        *panels, beside = row
        beside.set_axis_off()
        for axes, block in zip(panels, blocks, strict=True):
            axes.spines[["top", "right"]].set_visible(False)
            axes.grid(color="#dddddd", lw=0.5)
            axes.set_axisbelow(True)
            _draw_band(axes, campaign, block)
            top = _RANGE[1] * DOF[block]
            for i, name in enumerate(names):
                summary = campaign.filters[name]
                values = np.minimum(summary.curves[f"nees_{block}"], top)
                curve(axes, i, step, values, f"{name} ({summary.verdict})", width=0.9)
            axes.tick_params(labelsize=8)
        panels[0].set_ylabel(kind, fontsize=8)
        handles, labels = panels[0].get_legend_handles_labels()
        beside.legend(
            handles[1:], labels[1:], loc="center left", frameon=False, fontsize=8, borderpad=0
        )
    for axes, block in zip(grid[0], blocks, strict=False):
        axes.set_title(f"{block} NEES (dof {DOF[block]})", fontsize=9)
        _scale(axes, campaign, block)
    for axes in grid[-1, : len(blocks)]:
        axes.set(xlim=span(campaign.steps))
        axes.set_xlabel("step", fontsize=9)
    title = f"{head(campaign)}: NEES, average over {runs_of(campaign)}; shaded: 95 % band"
    figure.suptitle(title, x=0.01, ha="left", fontsize=10.5)
    return figure


def _draw_band(axes: Axes, campaign: Campaign, block: str) -> None:
    """Draw the 95 % band of the NEES, and its dof."""
    most = max(campaign.filters.values(), key=lambda summary: summary.counts["runs"]).curves
    step = np.arange(1, campaign.steps + 1)
    low, high = most[f"nees_{block}_low"], most[f"nees_{block}_high"]
    shade: dict[str, Any] = {"color": "#999999", "alpha": 0.45, "lw": 0}
    axes.fill_between(step, low, high, label="95 % band", zorder=1, **shade)
    axes.axhline(DOF[block], color=INK, lw=0.6, zorder=1.5)


def _scale(axes: Axes, campaign: Campaign, block: str) -> None:
    """Set the logarithmic scale of a column of panels, within `_RANGE`."""
    dof = DOF[block]
    every = np.concatenate(
        [
            np.ravel(summary.curves[f"nees_{block}{end}"])
            for summary in campaign.filters.values()
            for end in ("", "_low", "_high")
        ]
    )
    there = every[np.isfinite(every) & (every > 0)]
    low, high = (dof / 3, dof * 3) if not there.size else (there.min(), there.max())
    low, high = max(low, _RANGE[0] * dof), min(high, _RANGE[1] * dof)
    axes.set_yscale("log", nonpositive="mask")
    axes.set_ylim(min(low, dof / 3) / 1.2, max(high, dof * 3) * 1.2)
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("")
