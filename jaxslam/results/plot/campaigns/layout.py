"""How the filters of a campaign are divided into panels: all in one, or a row for each kind."""

from collections.abc import Container, Sequence
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxslam.catalog import KINDS
from jaxslam.consistency.campaign import Campaign
from jaxslam.core.validation import check_record
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
    names: dict[str, int]
    """each with its number (`numbers_of`)"""
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


def numbers_of(names: Sequence[str]) -> dict[str, int]:
    """The number of each filter of a campaign, which gives its look (`look`) in every figure.

    It is the place among the filters, by kind where there are more than five; so those of a panel
    have successive numbers.
    """
    if len(names) > TOGETHER:
        names = [name for _, members in kinds_of(names) for name in members]
    return {name: i for i, name in enumerate(names)}


def sheet(
    campaign: Campaign,
    quantities: Sequence[str],
    *,
    width: float,
    only: Container[str] | None = None,
    height: float | None = None,
    across: bool = False,
) -> tuple[Figure, list[Row]]:
    """An empty figure and its rows of panels, one panel for each quantity in each row.

    Up to five filters share a row, with the panels below each other, or side by side (across). The
    filters of a larger campaign have a row for each kind, and the figure is as wide as a page at
    least; panels of a quantity have the same ordinate.

    Args:
        quantities: what the panels show, with units.
        width: of the figure [in].
        only: the filters shown; default all.
        height: of a panel [in] of few filters; default by the width.
    """
    check_record("plot", "the first argument", campaign, Campaign)
    count = len(quantities)
    numbers = numbers_of(list(campaign.filters))
    groups = kinds_of([name for name in numbers if only is None or name in only])
    if len(numbers) <= TOGETHER or not groups:
        height = 0.22 * width + 0.35 if height is None else height
        tall = height * (1 if across else count) + 0.6
        shape = (1, count) if across else (count, 1)
        figure, panels = panels_of(width, tall, *shape, share=(True, across))
        for axes, quantity in zip(panels, quantities, strict=True):
            if across:
                titled(axes, quantity)
            else:
                ordinate(axes, quantity, height)
        mine = {name: i for name, i in numbers.items() if only is None or name in only}
        return figure, [Row("", mine, panels)]
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
        *own, beside = panels[i * (count + 1) : (i + 1) * (count + 1)]
        beside.set_axis_off()
        own[0].set_ylabel(kind.replace(" ", "\n"))
        rows.append(Row(kind, {name: numbers[name] for name in members}, own))
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
