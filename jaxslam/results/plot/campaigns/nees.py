"""Figure of the NEES of a campaign's filters over the steps, with the 95 % band."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxslam.consistency import DOF
from jaxslam.monte_carlo import Campaign
from jaxslam.results.plot.campaigns.layout import add_legends, head, runs_of, sheet
from jaxslam.results.plot.campaigns.scale import mark_beyond, nees_scale
from jaxslam.results.plot.style import INK, PAGE, band, curve, step_limits


def nees_figure(
    campaign: Campaign, *, blocks: Sequence[str] = tuple(DOF), width: float = PAGE
) -> Figure:
    """Average NEES over the steps for every filter of a campaign, with the 95 % chi-square band.

    The band is that of the filter with the most finite runs, the narrowest. More than five filters
    are drawn in a row of panels for each kind of filter (`catalog.KINDS`). The scale ends at 100
    times dof, or sooner where the band would be too narrow to be seen; marks at the edge are of
    larger values, and the largest is written above. width [in]: `COLUMN` is that of a paper.
    """
    titles = [f"{block} NEES (dof {DOF[block]})" for block in blocks]
    figure, rows = sheet(campaign, titles, width=width)
    step = np.arange(1, campaign.steps + 1)
    for axes, block in zip(rows[0].panels, blocks, strict=True):
        nees_scale(axes, campaign, block)
    for row in rows:
        for axes, block in zip(row.panels, blocks, strict=True):
            _draw_band(axes, campaign, block)
            for name, i in row.names.items():
                summary = campaign.filters[name]
                label = f"{name} ({summary.verdict})"
                curve(axes, i, step, summary.curves[f"nees_{block}"], label, absent="no NEES")
            axes.set_xlim(step_limits(campaign.steps))
            mark_beyond(axes)
    add_legends(figure, rows, f"{head(campaign)}: NEES, average over {runs_of(campaign)}", "step")
    return figure


def _draw_band(axes: Axes, campaign: Campaign, block: str) -> None:
    """Draw the 95 % band of the NEES, and its dof."""
    most = max(campaign.filters.values(), key=lambda summary: summary.counts["runs"]).curves
    step = np.arange(1, campaign.steps + 1)
    band(axes, step, most[f"nees_{block}_low"], most[f"nees_{block}_high"], "95 % band")
    axes.axhline(DOF[block], color=INK, lw=0.8, zorder=1.5, label="honest")
