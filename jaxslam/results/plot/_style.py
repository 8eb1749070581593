"""The one style of all figures: sizes, colours, lines, marks, legends, and files."""

import contextlib
import io
import textwrap
from collections.abc import Iterator, Sequence
from typing import Any, Literal, TypeAlias

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Figure  # re-exported: only this package imports Matplotlib
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.lines import Line2D

from jaxslam.core._optional import loading

Share: TypeAlias = bool | Literal["none", "all", "row", "col"]

Look: TypeAlias = dict[str, Any]
"""Look of an artist: Matplotlib's properties by name, whose types Matplotlib does not declare."""

PAGE, COLUMN = 7.16, 3.5
"""Widths [in] of the text and of a column of a two-column paper."""

TEXT, TITLE = 8.0, 9.0
"""Sizes of letters [pt] in a figure of any width."""

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#8c6d31")
"""A palette for colour-blind readers (Okabe & Ito)."""

INK, FAINT, SHADE, RULE = "#333333", "#777777", "#bdbdbd", "#dddddd"
"""Colours of everything but filters: lines and text, dead reckoning, bands, the grid."""

HUES = (*COLORS[:4], "#c98500", "#7d5f1f")
"""Colours of filters; yellow and brown can be seen on a grey band."""

_DASHES = ("-", (0, (5, 1.4)), (0, (1.4, 1.1)), (0, (6, 1.3, 1.4, 1.3)), (4.5, (9, 2)))
_MARKS = ("o", "s", "^", "D", "v")

CURVE = "curve"
"""`gid` of the lines of filters."""

_FEW = 12
"""Largest number of values of a curve with a mark at each; a longer one has some six marks."""

_NO_DATE = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}


def look(i: int) -> Look:
    """Options of the line of filter number i: colour, dashes and mark.

    Thirty differ in colour and dashes; five differ in dashes and marks alone, without colour.
    """
    return {
        "color": HUES[i % len(HUES)],
        "ls": _DASHES[i % len(_DASHES)],
        "marker": _MARKS[i % len(_MARKS)],
        "mec": INK,
        "mew": 0.4,
    }


@contextlib.contextmanager
def own_settings() -> Iterator[None]:
    """A block, or by @own_settings() a function, in which Matplotlib has its defaults and ours.

    A figure does not depend on the user's matplotlibrc: neither on LaTeX, nor on fonts, sizes, or
    decimal commas. The settings of the user are restored at the end.
    """
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams["pdf.fonttype"] = 42  # TrueType, which publishers require
        matplotlib.rcParams["svg.hashsalt"] = "jaxslam"  # reproducible names of parts
        yield


def check_font() -> None:
    """Raise `Unusable` if Matplotlib has no font to write with: its own is missing or damaged."""
    with loading("figures", "matplotlib"), own_settings():
        get_font(findfont(FontProperties()))


@own_settings()
def encode(figure: Figure, kind: str, dpi: float = 200) -> bytes:
    """The figure as a file of a kind, png, pdf or svg; equal figures give equal bytes."""
    out = io.BytesIO()
    figure.savefig(out, format=kind, dpi=dpi, metadata=_NO_DATE.get(kind))
    return out.getvalue()


def pictures(name: str, figure: Figure, kinds: Sequence[str]) -> dict[str, bytes]:
    """The figure as files of some kinds, by their names."""
    return {f"{name}.{kind}": encode(figure, kind) for kind in kinds}


def png(figure: Figure, dpi: float = 200) -> bytes:
    """The figure as a PNG file with dpi dots an inch."""
    return encode(figure, "png", dpi)


def describe(figure: Figure) -> str:
    """A sentence that describes the figure, for readers who cannot see it."""
    panels = [
        " ".join(filter(None, (a.get_title(), a.get_title("left"), a.get_ylabel())))
        for a in figure.axes
    ]
    across = next(filter(None, (a.get_xlabel() for a in figure.axes)), "")
    legends = [*figure.legends, *filter(None, (a.get_legend() for a in figure.axes))]
    named = [text.get_text() for legend in legends for text in legend.get_texts()]
    text = f"{'; '.join(filter(None, panels))} against {across}".replace("\n", " ")
    return (f"{text}. Drawn: {', '.join(named)}." if named else f"{text}.").replace(r"\$", "$")


class _ShownFigure(Figure):
    """A figure that a notebook shows as it is, whether or not pyplot was imported.

    Matplotlib leaves room for the labels of a panel of equal scales before the panel has taken its
    shape, so that labels may lie outside: such a figure is laid out twice.
    """

    @own_settings()
    def savefig(self, *args: Any, **options: Any) -> None:
        """Write the figure, as Matplotlib does it."""
        if any(axes.get_aspect() != "auto" for axes in self.axes):
            self.draw_without_rendering()
        super().savefig(*args, **options)

    def _repr_png_(self) -> bytes:
        """The figure as a PNG file, for the screen."""
        return png(self, dpi=110)


@own_settings()
def panels_of(
    width: float,
    height: float,
    rows: int,
    columns: int = 1,
    *,
    share: tuple[Share, Share] = (True, False),
    widths: Sequence[float] | None = None,
    heights: Sequence[float] | None = None,
) -> tuple[Figure, list[Axes]]:
    """An empty figure, width by height inches, and its panels row by row.

    share: whether panels share abscissae and ordinates, as in Matplotlib. widths, heights:
    ratios of columns and rows.
    """
    check_font()
    figure = _ShownFigure(figsize=(width, height), dpi=150, layout="constrained")
    grid = figure.subplots(
        rows,
        columns,
        sharex=share[0],
        sharey=share[1],
        squeeze=False,
        width_ratios=widths,
        height_ratios=heights,
    )
    for axes in grid.flat:
        axes.spines[["top", "right"]].set_visible(False)
        axes.spines[["bottom", "left"]].set_linewidth(0.8)
        axes.grid(color=RULE, lw=0.5)
        axes.set_axisbelow(True)
        axes.tick_params(which="both", labelsize=TEXT, width=0.8)
        axes.tick_params(length=3)
        for text in (axes.xaxis.label, axes.yaxis.label):
            text.set_size(TEXT)
    return figure, list(grid.flat)


def ordinate(axes: Axes, text: str, height: float) -> None:
    """Label the ordinate; in two lines if the panel is too low for one, height [in]."""
    if len(text) * 4.5 > 0.9 * 72 * height:  # 4.5 pt a letter, 72 pt an inch
        text = text.replace(" (", "\n(").replace(" [", "\n[")
    axes.set_ylabel(text)


def titled(axes: Axes, text: str) -> None:
    """Write the title of a panel above its left end."""
    axes.set_title(text, loc="left", fontsize=TEXT)


def curve(
    axes: Axes, i: int, x: np.ndarray, y: np.ndarray, label: str, *, absent: str = "no values"
) -> None:
    """Draw the curve of filter number i with marks, shifted against the marks of its neighbours.

    absent: the entry in the legend of a curve without a finite value.
    """
    label, finite = escape_name(label), np.isfinite(x) & np.isfinite(y)
    if not finite.any():
        axes.plot([], [], ls="none", label=f"{label}: {absent}", gid=CURVE)
        return
    mark_every: tuple[int, int] | None = None  # first value and interval
    if finite.sum() > _FEW:
        interval = max(len(y) // 6, 1)
        # Marks of neighbouring filters are 0.4 intervals apart.
        mark_every = (int(interval * (0.1 + 0.4 * i % 1)), interval)
    axes.plot(
        x,
        y,
        lw=1.1,
        ms=3.6,
        markevery=mark_every,
        label=label,
        gid=CURVE,
        zorder=3 + 0.01 * i,
        **look(i),
    )


def curves_of(axes: Axes) -> list[Line2D]:
    """The lines that `curve` has drawn."""
    return [line for line in axes.lines if line.get_gid() == CURVE]


def band(axes: Axes, x: np.ndarray, low: np.ndarray, high: np.ndarray, label: str) -> None:
    """Shade the area between two curves, light and with thin edges, so that curves stand out."""
    look: Look = {"fc": (SHADE, 0.35), "ec": FAINT, "lw": 0.4}
    axes.fill_between(x, low, high, label=label, zorder=1, **look)


def escape_name(name: str) -> str:
    """A name escaped for Matplotlib: without formulas, and not hidden from the legend."""
    name = name.replace("$", r"\$")
    return f" {name}" if name.startswith("_") else name


def caption(figure: Figure, title: str, handles: Sequence[Artist] | None = None) -> None:
    """Add title and legend above the panels; the figure grows with their lines.

    handles: of the legend; by default those with a label in the first panel.
    """
    handles = figure.axes[0].get_legend_handles_labels()[0] if handles is None else handles
    labels = [str(handle.get_label()) for handle in handles]
    width = 72 * figure.get_figwidth()
    # As many columns as fit: a letter is some 4.3 pt wide, a handle with its gaps 36 pt.
    columns = 1
    for count in range(2, min(len(labels), 6) + 1):
        parts = np.array_split(np.array([len(label) for label in labels]), count)
        if sum(4.3 * part.max() + 36 for part in parts) < width:
            columns = count
    lines = textwrap.wrap(title, int(width / 4.9))  # letters of the title are larger
    extra_lines = -(-len(labels) // columns) - 1 + max(len(lines) - 1, 0)
    figure.set_figheight(figure.get_figheight() + 0.16 * extra_lines)
    figure.legend(
        handles,
        labels,
        loc="outside upper left",
        title="\n".join(lines) or None,
        alignment="left",
        frameon=False,
        ncols=columns,
        fontsize=TEXT,
        title_fontsize=TITLE,
        columnspacing=1.2,
        handlelength=2.6,
        borderpad=0.2,
        labelspacing=0.3,
    )


def every_handle(panels: Sequence[Axes]) -> list[Artist]:
    """The handles for the legend of some panels, the last one of each label."""
    handles = [handle for axes in panels for handle in axes.get_legend_handles_labels()[0]]
    return list({handle.get_label(): handle for handle in handles}.values())


def step_limits(steps: int) -> tuple[float, float]:
    """The limits of the abscissa, with some width if there is a single step."""
    return (1, steps) if steps > 1 else (0.5, 1.5)
