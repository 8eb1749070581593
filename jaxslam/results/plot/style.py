"""Parts of every figure: colours, panels, curves, captions and axes."""

import io
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Figure  # re-exported: only this package imports Matplotlib

from jaxslam.monte_carlo import Campaign

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#8c6d31")
"""A palette for colour-blind readers (Okabe & Ito)."""

INK = "#333333"

_HUES = 6
_DASHES = ("-", (0, (4, 1.6)), (0, (1, 1.2)), (0, (5, 1, 1, 1)))
_MARKS = ("o", "s", "^", "D")
"""Six colours are used in turn, then again with other dashes and markers."""


def png(figure: Figure, dpi: float = 180) -> bytes:
    """The figure as a PNG file with dpi dots an inch."""
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=dpi)
    return out.getvalue()


def warm_up() -> None:
    """Load fonts and the formula renderer, which takes half a second once a process."""
    figure, (axes, *_) = panels_of(1.0, 1.0, 1)
    axes.set_title("$x^2$")
    png(figure, dpi=10)


def describe(figure: Figure) -> str:
    """A sentence that describes the figure, for readers who cannot see it."""
    panels = [" ".join(filter(None, (a.get_title(), a.get_ylabel()))) for a in figure.axes]
    across = next(filter(None, (a.get_xlabel() for a in figure.axes)), "")
    legends = [*figure.legends, *filter(None, (a.get_legend() for a in figure.axes))]
    named = [text.get_text() for legend in legends for text in legend.get_texts()]
    said = f"{'; '.join(filter(None, panels))} against {across}"
    return (f"{said}. Drawn: {', '.join(named)}." if named else f"{said}.").replace(r"\$", "$")


def panels_of(
    width: float, height: float, rows: int, columns: int = 1
) -> tuple[Figure, list[Axes]]:
    """An empty figure, width by height inches, and its panels row by row."""
    figure = Figure(figsize=(width, height), dpi=150, layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, sharey=columns > 1, squeeze=False)
    for axes in grid.flat:
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(color="#dddddd", lw=0.5)
        axes.set_axisbelow(True)
    return figure, list(grid.flat)


def curve(
    axes: Axes,
    i: int,
    x: np.ndarray,
    y: np.ndarray,
    label: str,
    *,
    mark: float = 0.0,
    width: float = 1.2,
) -> None:
    """Draw the curve of filter number i; width and size of marks in points, mark 0 for none."""
    dashes = _DASHES[i // _HUES % len(_DASHES)]
    marks: dict[str, Any] = {"marker": _MARKS[i // _HUES % len(_MARKS)], "ms": mark or 3.0}
    axes.plot(
        x,
        y,
        color=COLORS[i % _HUES],
        ls=dashes,
        lw=width,
        label=plain(label),
        zorder=3 + 0.01 * i,
        **(marks if mark else lone_mark(y)),
    )


def lone_mark(y: np.ndarray) -> dict[str, Any]:
    """Options that draw a marker where a curve has a single finite value, and so no line."""
    return {"marker": "o", "ms": 3.0} if np.isfinite(y).sum() == 1 else {}


def plain(name: str) -> str:
    """A name escaped for Matplotlib: without formulas, and not hidden from the legend."""
    name = name.replace("$", r"\$")
    return f" {name}" if name.startswith("_") else name


def logarithmic(axes: Axes) -> None:
    """Make the ordinate logarithmic where positive values span more than a decade.

    Numbers are plain; minor ticks have numbers where there are few decades.
    """
    if not np.isfinite(axes.dataLim.minposy):
        return  # Matplotlib raises without positive values
    low, high = axes.get_ylim()
    if 0 < high < 10 * low:
        return
    axes.set_yscale("log", nonpositive="mask")
    low, high = axes.get_ylim()
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(few_digits if high < 100 * low else "")


def few_digits(x: float, _: float) -> str:
    """The label of a minor tick on a logarithmic axis: 2 and 5 of each decade have one."""
    return f"{x:g}" if f"{x:.0e}"[0] in "25" else ""


def caption(figure: Figure, title: str) -> None:
    """Add title and legend above the panels; the figure grows with the rows of the legend."""
    handles, labels = figure.axes[0].get_legend_handles_labels()
    width = 72 * figure.get_figwidth()
    columns = 1
    for more in range(2, min(len(labels), 6) + 1):
        parts = np.array_split(np.array([len(label) for label in labels]), more)
        if sum(4.4 * part.max() + 40 for part in parts) < width:
            columns = more
    figure.set_figheight(figure.get_figheight() + 0.17 * (-(-len(labels) // columns) - 1))
    legend = figure.legend(
        handles,
        labels,
        loc="outside upper left",
        title=title or None,
        alignment="left",
        frameon=False,
        ncols=columns,
        fontsize=8,
        title_fontsize=10.5,
        columnspacing=1.4,
        handlelength=2.4,
    )
    for line in legend.get_lines():
        line.set_linewidth(1.6)


def head(campaign: Campaign) -> str:
    """The name of a campaign's scenario, for a title."""
    return plain(campaign.scenario)


def runs_of(campaign: Campaign) -> str:
    """The number of runs of a campaign in words."""
    return f"{campaign.runs:,} run{'s' if campaign.runs != 1 else ''}"


def span(steps: int) -> tuple[float, float]:
    """The limits of the abscissa, with some width if there is a single step."""
    return (1, steps) if steps > 1 else (0.5, 1.5)
