"""The figures: NEES of matchers and covariances by world; errors over iterations."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from benchmarks.scan_matching.honesty import COVARIANCES, MATCHERS, WORLDS, Row
from jaxslam.results.plot.style import (
    COLUMN,
    INK,
    PAGE,
    SHADE,
    caption,
    curve,
    look,
    panels_of,
    png,
    titled,
)

LIMITS = 0.1, 1e3


def nees(rows: Sequence[Row]) -> Figure:
    """NEES over its degrees of freedom, a panel a world; beyond the axis at its end."""
    figure, axes = panels_of(PAGE, 2.8, 1, len(WORLDS), share=(True, True))
    names = list(COVARIANCES)
    for panel, world in zip(axes, WORLDS, strict=True):
        own = [row for row in rows if row.world == world]
        panel.axvspan(own[0].low, own[0].high, color=SHADE, lw=0)
        panel.axvline(1.0, color=INK, lw=0.6)
        for row in own:
            k = list(MATCHERS).index(row.matcher)
            line = look(k)
            beyond = not LIMITS[0] < row.nees < LIMITS[1]
            panel.plot(
                np.clip(row.nees, LIMITS[0] * 1.15, LIMITS[1] / 1.15),
                names.index(row.way) + 0.16 * (k - 2),
                ls="none",
                marker=line["marker"],
                color=line["color"],
                ms=4,
                mfc="white" if beyond else line["color"],
                label=row.matcher if row.way == "hessian" else None,
            )
        panel.set(xscale="log", xlim=LIMITS)
        titled(panel, world)
        panel.set_yticks(range(len(names)), names)
        panel.grid(axis="y", visible=False)
    axes[0].invert_yaxis()
    caption(figure, "NEES over degrees of freedom (1: honest); open marks lie beyond the axis")
    return figure


def convergence(errors: dict[str, np.ndarray]) -> Figure:
    """The distance from the limit over iterations."""
    figure, (axes,) = panels_of(COLUMN, 2.4, 1)
    for k, (name, error) in enumerate(errors.items()):
        shown = np.where(error > 0, error, np.nan)
        label = {"point_to_point": "ICP", "point_to_line": "PL-ICP"}[name]
        curve(axes, k, np.arange(len(shown)), shown, label)
    axes.set_yscale("log")
    axes.set_xlabel("iteration")
    axes.set_ylabel("distance from the limit [m]")
    caption(figure, "")
    return figure


def save(figure: Figure, name: str) -> None:
    (Path(__file__).parents[1] / "figures" / f"{name}.png").write_bytes(png(figure))
