"""Panels of a campaign's filters, all in one or a row for each kind, and their scales.

One extreme filter does not set a scale; values beyond it are marked.
"""

from collections.abc import Container, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from jaxslam.catalog import KINDS
from jaxslam.consistency._measures.nees import DOF
from jaxslam.consistency.campaign import Campaign
from jaxslam.core.validation import instance_of, refusals_of, require
from jaxslam.results.plot._style import (
    INK,
    PAGE,
    TEXT,
    caption,
    curves_of,
    escape_name,
    ordinate,
    panels_of,
    titled,
)

TOGETHER = 5
"""Largest number of curves in a panel: five marks differ without colour."""


class Row(NamedTuple):
    """Filters that are drawn together."""

    kind: str
    names: dict[str, int]
    """the number of each filter (`numbers_of`) by its name"""
    panels: list[Axes]
    """a panel for each quantity"""


def kinds_of(names: Sequence[str]) -> list[tuple[str, list[str]]]:
    """Groups (kind, names) of at most five filters: the kinds of `catalog.KINDS`, then others."""
    kind_of = {name: kind for kind, members in KINDS.items() for name in members}
    groups = []
    for kind in [*KINDS, "others"]:
        members = [name for name in names if kind_of.get(name, "others") == kind]
        groups += [(kind, members[i : i + TOGETHER]) for i in range(0, len(members), TOGETHER)]
    return groups


def numbers_of(names: Sequence[str]) -> dict[str, int]:
    """The number of each filter of a campaign, which gives its look (`look`) in every figure.

    It is the position among the filters, sorted by kind if they are more than five; so the filters
    of a panel have successive numbers.
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
    with refusals_of("plot"):
        require("campaign", campaign, instance_of(Campaign))
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
        chosen = {name: i for name, i in numbers.items() if only is None or name in only}
        return figure, [Row("", chosen, panels)]
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
        *measured, beside = panels[i * (count + 1) : (i + 1) * (count + 1)]
        beside.set_axis_off()
        measured[0].set_ylabel(kind.replace(" ", "\n"))
        rows.append(Row(kind, {name: numbers[name] for name in members}, measured))
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
    curves = curves_of(rows[0].panels[0])
    everything = rows[0].panels[0].get_legend_handles_labels()[0]
    caption(figure, title, [handle for handle in everything if handle not in curves])


def title_of(campaign: Campaign, subject: str) -> str:
    """The title of a figure: the scenario, the subject, and the number of runs."""
    runs = f"{campaign.runs:,} run{'s' if campaign.runs != 1 else ''}"
    return f"{escape_name(campaign.scenario)}: {subject} {runs}"


_FAR = 3.0
"""Multiple of the median beyond which the curve of a filter does not set a scale."""

_NEES_ENDS = (1 / 10, 10.0, 100.0)
"""Lowest lower end of a scale of NEES, and lowest and highest upper end, in multiples of dof."""

_BAND = 0.06
"""Share of the height of a panel that the 95 % band fills at least, where the scale allows it."""

_POWERS = 6
"""Largest number of powers of ten for which a logarithmic axis labels all of them."""

BEYOND = "beyond"
"""`gid` of the marks of values beyond an axis."""

_NO_MARK = "", " ", "None", "none"
"""Matplotlib's names for a line without markers."""

_PLACES = 12
"""Number of marks along an edge."""


def scale_setters(campaign: Campaign) -> list[str]:
    """The filters that set the scale of errors: those that fused measurements and are accurate.

    All filters if there are none.
    """
    names = [
        name
        for name, summary in campaign.filters.items()
        if summary.counts.get("fused", 0) > 0
        and summary.verdict != "diverged"
        and summary.counts.get("inaccurate", 0) <= summary.counts["runs"] / 2
    ]
    return names or list(campaign.filters)


def common_top(peaks: dict[str, float], setters: list[str]) -> float:
    """The largest of the peaks that are at most three times the median peak of the setters.

    0 without a finite peak.
    """
    finite = {name: peak for name, peak in peaks.items() if np.isfinite(peak)}
    chosen = [peak for name, peak in finite.items() if name in setters] or list(finite.values())
    if not chosen:
        return 0.0
    limit = _FAR * sorted(chosen)[len(chosen) // 2]
    return max(peak for peak in finite.values() if peak <= limit)


def nees_scale(axes: Axes, campaign: Campaign, block: str) -> None:
    """Set the ordinate for the NEES of a block, the 95 % band visible.

    It shows the values of all filters within 0.1 to 100 times dof, and less above where the band is
    narrow; logarithmic over more than a decade.
    """
    dof = DOF[block]

    def positive_values(end: str) -> np.ndarray:
        curves = (summary.curves[f"nees_{block}{end}"] for summary in campaign.filters.values())
        values = np.concatenate([np.ravel(curve) for curve in curves])
        return values[np.isfinite(values) & (values > 0)]

    values, below, above = positive_values(""), positive_values("_low"), positive_values("_high")
    shown = np.concatenate([values, below, above, [dof / 1.5, dof * 1.5]])
    low = max(shown.min(), _NEES_ENDS[0] * dof)
    # The length of the axis, as a logarithm, over which the band fills the share `_BAND`. At most
    # exp(50), which does not overflow.
    length = np.log(np.median(above) / np.median(below)) / _BAND if below.size else np.inf
    cap = dof * np.clip(low / dof * np.exp(min(length, 50.0)), *_NEES_ENDS[1:])
    set_positive(axes, low, min(shown.max(), cap))


def set_positive(
    axes: Axes,
    low: float,
    high: float,
    which: str = "y",
    *,
    margin: float = 0.06,
    linear: float = 10.0,
) -> None:
    """Set an axis (x or y) for numbers from low to high, with a margin as a share of the length.

    It is logarithmic if the largest is over `linear` times the smallest, with labels at 1, 2 and 5
    of each decade, or 1 and 3, or 1 alone, by the room.
    """
    axis = axes.yaxis if which == "y" else axes.xaxis
    set_limits = axes.set_ylim if which == "y" else axes.set_xlim
    if high <= linear * low:
        room = margin * (high - low) or 0.1 * high
        set_limits(max(low - room, 0.0), high + room)
        return
    axes.set(**{f"{which}scale": "log"})
    room = (high / low) ** margin
    set_limits(low / room, high * room)
    length, label = (axes.bbox.height, 11) if which == "y" else (axes.bbox.width, 28)  # [pt]
    length *= 72 / axes.figure.dpi
    axis.set_major_locator(LogLocator(numticks=int(np.clip(length / label, 2, _POWERS))))
    axis.set_major_formatter(_tick_label)
    decade = length / np.log10(high / low)
    # Labels at 2 and 5, or at 3, where they are farther apart than a label is long.
    digits = next((d for d in ("25", "3") if np.log10(int(d[0])) * decade > label), "")
    if digits:
        axis.set_minor_formatter(lambda x, _: _tick_label(x) if f"{x:.0e}"[0] in digits else "")
    else:
        axis.set_minor_locator(NullLocator())


def _tick_label(x: float, _: float = 0.0) -> str:
    return f"{x:g}" if 1e-3 <= abs(x) < 1e5 else power(x)


def power(x: float) -> str:
    """A positive number to two digits, with a power of ten where it is large or small."""
    if 1e-3 <= x < 1e4:
        return f"{x:.2g}" if x < 100 else f"{x:.0f}"
    mantissa, exponent = f"{x:.0e}".split("e")
    times = "" if mantissa == "1" else rf"{mantissa}\cdot "
    return f"${times}10^{{{int(exponent)}}}$"


def mark_beyond(axes: Axes) -> None:
    """Mark values beyond the ends of the ordinate with the markers of their curves, at the edges.

    Marks of different filters are at different places; a curve without marks has arrows. The
    greatest value is written above the panel, the least one only if the axis goes below 0. Call it
    after the limits are set.
    """
    low, high = axes.get_ylim()
    left, right = axes.get_xlim()
    curves, largest, least = curves_of(axes), -np.inf, np.inf
    for i, line in enumerate(curves):
        x, y = (np.asarray(part, float) for part in line.get_data())
        order = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
        if not order.size:
            continue
        x, y = x[order], y[order]
        places = x
        if len(x) > _PLACES:
            offset = (i + 0.5) / max(len(curves), 1)
            places = np.interp((np.arange(_PLACES) + offset) / _PLACES, [0, 1], [left, right])
        near = np.abs(x[:, None] - places).argmin(axis=0)
        marker = str(line.get_marker())
        for beyond, edge, arrow in ((y > high, 1.0, "$\u2191$"), (y < low, 0.0, "$\u2193$")):
            if not beyond.any():
                continue
            # Of the regular places those beyond; the first such value if no place is.
            marked = np.unique(near[beyond[near]])
            marked = marked if marked.size else np.flatnonzero(beyond)[:1]
            axes.plot(
                x[marked],
                np.full(len(marked), edge),
                marker=arrow if marker in _NO_MARK else marker,
                linestyle="none",
                transform=axes.get_xaxis_transform(),
                color=line.get_color(),
                mec=INK,
                mew=0.4,
                ms=4.5,
                clip_on=False,
                zorder=6,
                gid=BEYOND,
            )
        largest = max(largest, y.max())
        least = min(least, y.min())
    texts = [f"↑ to {power(largest)}"] if largest > high else []
    texts += [f"↓ to −{power(-least)}"] if least < low < 0 else []
    if texts:
        axes.set_title(", ".join(texts), loc="right", fontsize=7, color=INK)
