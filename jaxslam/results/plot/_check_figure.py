"""The figure of a log beside its twins: a histogram for each statistic."""

import textwrap

import numpy as np

from jaxslam.consistency import ModelCheck
from jaxslam.core.validation import instance_of, refusals_of, require
from jaxslam.results.plot._style import (
    COLORS,
    FAINT,
    PAGE,
    SHADE,
    Figure,
    caption,
    escape_name,
    own_settings,
    panels_of,
)

_SMALL = 6.0
"""Size of letters [pt] in small panels."""

_REACH = 1.5
"""Largest distance of the log beyond its twins, in their range, that a panel shows to scale."""


@own_settings()
def check_figure(check: ModelCheck, *, title: str = "", width: float = PAGE) -> Figure:
    """A histogram of the twins for each statistic and a line at the log's, worst first.

    A log far beyond its twins has an arrow at the edge. check: of `consistency.check_models`.
    """
    with refusals_of("check_figure"):
        require("check", check, instance_of(ModelCheck))
    columns = max(int(width / 1.15), 1)
    rows = -(-len(check.statistics) // columns)
    figure, panels = panels_of(width, 0.95 * rows + 0.3, rows, columns, share=(False, False))
    for axes, row in zip(panels, check.statistics, strict=False):
        # The twins, and the log where it is, or at the edge beyond which it is.
        twins, value = row.twins, row.statistic.value
        low, high = float(twins.min()), float(twins.max())
        reach = _REACH * max(high - low, 1e-12)
        shown = float(np.clip(value, low - reach, high + reach))
        color = COLORS[1] if row.contradicts else COLORS[0]
        axes.hist(twins, bins=12, color=SHADE, edgecolor=FAINT, lw=0.3, label="twins")
        axes.axvline(shown, color=color, lw=1.4, label="log")
        if shown != value:
            axes.plot(
                [shown],
                [0.9 * axes.get_ylim()[1]],
                ">" if shown < value else "<",
                color=color,
                ms=4,
            )
        p = "< 0.001" if row.corrected < 1e-3 else f"{row.corrected:.2g}"
        name = "\n".join(textwrap.wrap(escape_name(row.statistic.name), 22)[:2])
        axes.set_title(f"{name}\np {p}", loc="left", fontsize=_SMALL, pad=2)
        axes.tick_params(labelsize=_SMALL, length=2, pad=1)
        axes.locator_params(axis="x", nbins=3)
        axes.set_yticks([])
        axes.grid(visible=False)
    for axes in panels[len(check.statistics) :]:
        axes.set_axis_off()
    contradicting = sum(row.contradicts for row in check.statistics)
    text = title or (
        f"{escape_name(check.name)}, {escape_name(check.filter)}: {contradicting} of "
        f"{len(check.statistics)} statistics are not those of {check.twins} twins"
    )
    caption(figure, text)
    return figure
