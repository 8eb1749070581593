"""How the filters of a campaign are divided into panels: all in one, or a row for each kind."""

from collections.abc import Sequence
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxslam.catalog import KINDS
from jaxslam.monte_carlo import Campaign
from jaxslam.results.plot.style import (
    PAGE,
    TEXT,
    caption,
    curves_of,
    ordinate,
    panels_of,
    plain,
    titled,
)

TOGETHER = 5
"""largest number of curves in a panel"""


class Row(NamedTuple):
    """Filters that are drawn together."""

    kind: str
    names: list[str]
    panels: list[Axes]
    """one for each quantity"""


def kinds_of(names: Sequence[str]) -> list[tuple[str, list[str]]]:
    """Groups (kind, names) of at most five filters: those of `catalog.KINDS`, then others."""
    known = {name: kind for kind, members in KINDS.items() for name in members}
    found = []
    for kind in [*KINDS, "others"]:
        mine = [name for name in names if known.get(name, "others") == kind]
        found += [(kind, mine[at : at + TOGETHER]) for at in range(0, len(mine), TOGETHER)]
    return found


def sheet(
    names: Sequence[str],
    quantities: Sequence[str],
    *,
    width: float,
    height: float | None = None,
    across: bool = False,
) -> tuple[Figure, list[Row]]:
    """An empty figure and its rows of panels, one panel for each quantity in each row.

    Up to five filters share a row, with the panels below each other, or side by side (across). More
    filters have a row for each kind, and the figure is as wide as a page at least; panels of a
    quantity have the same ordinate.

    Args:
        quantities: what the panels show, with units.
        width: of the figure [in].
        height: of a panel [in] of few filters; default by the width.
    """
    count = len(quantities)
    if len(names) <= TOGETHER:
        height = 0.22 * width + 0.35 if height is None else height
        tall = height * (1 if across else count) + 0.6
        shape = (1, count) if across else (count, 1)
        figure, panels = panels_of(width, tall, *shape, share=(True, across))
        for axes, quantity in zip(panels, quantities, strict=True):
            if across:
                titled(axes, quantity)
            else:
                ordinate(axes, quantity, height)
        return figure, [Row("", list(names), panels)]
    groups = kinds_of(names)
    figure, panels = panels_of(
        max(width, PAGE),
        1.05 * len(groups) + 0.7,
        len(groups),
        count + 1,
        share=("col", "col"),
        widths=[*[1.0] * count, 0.02],
    )
    rows = []
    for i, (kind, members) in enumerate(groups):
        *mine, beside = panels[i * (count + 1) : (i + 1) * (count + 1)]
        beside.set_axis_off()
        mine[0].set_ylabel(kind.replace(" ", "\n"))
        rows.append(Row(kind, members, mine))
    for axes, quantity in zip(rows[0].panels, quantities, strict=True):
        titled(axes, quantity)
    return figure, rows


def add_legends(figure: Figure, rows: Sequence[Row], title: str, across: str) -> None:
    """Add the legends, the title, and the label of the abscissa across the last row."""
    for axes in rows[-1].panels:
        axes.set_xlabel(across)
    if not rows[0].kind:
        for axes in rows[0].panels:
            axes.label_outer()
        caption(figure, title)
        return
    for row in rows:
        curves = curves_of(row.panels[0])
        beside = figure.axes[figure.axes.index(row.panels[-1]) + 1]
        beside.legend(
            curves,
            [str(curve.get_label()) for curve in curves],
            loc="center left",
            frameon=False,
            fontsize=TEXT,
            borderpad=0,
            handlelength=2.6,
        )
    own = curves_of(rows[0].panels[0])
    everything = rows[0].panels[0].get_legend_handles_labels()[0]
    caption(figure, title, [handle for handle in everything if handle not in own])


def head(campaign: Campaign) -> str:
    """The name of a campaign's scenario, for a title."""
    return plain(campaign.scenario)


def runs_of(campaign: Campaign) -> str:
    """The number of runs of a campaign in words."""
    return f"{campaign.runs:,} run{'s' if campaign.runs != 1 else ''}"
