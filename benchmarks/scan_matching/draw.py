"""The figures: NEES of matchers and covariances by world; errors over iterations."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from benchmarks.scan_matching.honesty import COVARIANCES, MATCHERS, WORLDS, Error, Row
from jaxslam.results.plot import (
    COLUMN,
    FAINT,
    INK,
    PAGE,
    SHADE,
    caption,
    curve,
    look,
    panels_of,
    titled,
)

LIMITS = 0.1, 1e3
TICKS = 0.1, 1, 10, 100, 1000
BOUND = "squared error\nover bound"


def nees(rows: Sequence[Row], errors: Sequence[Error]) -> Figure:
    """NEES over its degrees of freedom, a panel a world; open marks lie beyond the axis.

    Last row: the mean squared error over the Cramér-Rao bound, which is the NEES of a match that
    claims the bound.
    """
    figure, axes = panels_of(PAGE, 3.2, 1, len(WORLDS), share=(True, True))
    places = {way: float(at) for at, way in enumerate([*COVARIANCES, BOUND])}
    places[BOUND] += 0.3
    shown = [(r.world, r.matcher, r.way, r.nees) for r in rows]
    shown += [(e.world, e.matcher, BOUND, e.over_bound) for e in errors]
    for panel, world in zip(axes, WORLDS, strict=True):
        band = next(row for row in rows if row.world == world)
        panel.axvspan(band.low, band.high, color=SHADE, lw=0)
        panel.axvline(1.0, color=INK, lw=0.6)
        panel.axhline(places[BOUND] - 0.65, color=FAINT, lw=0.6)
        for k, matcher in enumerate(MATCHERS):
            full = {**look(k), "ls": "none", "ms": 4.5, "clip_on": False, "zorder": 3}
            hollow = {**full, "mfc": "white", "mec": full["color"], "mew": 1.0}
            for own_world, own, way, value in shown:
                if (own_world, own) == (world, matcher):
                    panel.plot(
                        np.clip(value, *LIMITS),
                        places[way] + 0.16 * (k - 2),
                        **(full if LIMITS[0] <= value <= LIMITS[1] else hollow),
                        label=matcher if way == BOUND else None,
                    )
        panel.set(xscale="log", xlim=LIMITS)
        panel.set_xticks(TICKS, [f"{tick:g}" for tick in TICKS])
        titled(panel, world)
        panel.set_yticks(list(places.values()), list(places))
        panel.tick_params(axis="y", length=0)
        panel.grid(axis="y", visible=False)
    axes[0].invert_yaxis()
    caption(
        figure,
        "NEES over degrees of freedom (1: honest), and squared error over the Cramér–Rao bound",
    )
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
