"""Figures of occupancy grids, with poses and beams in them."""

from collections.abc import Mapping

import numpy as np
from matplotlib.colors import Colormap, LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import ArrayLike

from jaxslam.core.types import Beams
from jaxslam.laser.grids import Field, Grid
from jaxslam.results.plot.style import (
    COLORS,
    FAINT,
    INK,
    PAGE,
    TEXT,
    Look,
    caption,
    every_handle,
    panels_of,
)

_UNKNOWN = "#c9d3dd"
"""Colour of unknown cells, which no shade of grey has."""


def grid_figure(
    grid: Grid | Field,
    *,
    poses: ArrayLike | None = None,
    beams: Beams | None = None,
    others: Mapping[str, ArrayLike] | None = None,
    label: str = "",
    title: str = "",
    width: float = PAGE / 2,
) -> Figure:
    """The map: occupied cells black, free ones white, unknown ones in a colour of their own.

    Args:
        grid: a map; or a `Field`, as a distance field, whose values are shown in colours.
        poses: (T, 2 or 3) drawn as a path with its end.
        beams: a scan from the last pose.
        others: other paths by name, drawn thin, as a reference.
        label: of the scale of a field.
        width: [in].
    Raises:
        ValueError: beams without poses of three numbers.
    """
    path = None if poses is None else np.atleast_2d(np.asarray(poses))
    if beams is not None and (path is None or path.shape[1] != 3):
        raise ValueError("grid_figure: beams are from the last of poses (x, y, θ)")
    values = np.asarray(grid[0])
    frame = np.asarray(grid.origin, float), float(np.asarray(grid.resolution))
    rows, columns = (np.arange(n + 1) for n in values.shape)
    x, y = world_of(*frame, columns[None, :] + 0.0 * rows[:, None], rows[:, None] + 0.0 * columns)
    inner = width - (0.6 if isinstance(grid, Grid) else 1.3)
    height = inner * np.ptp(y) / np.ptp(x) + 0.8
    figure, (axes,) = panels_of(width, min(height, 9.0), 1)
    axes.grid(visible=False)
    if isinstance(grid, Grid):
        look: Look = {"cmap": shades_of_occupancy(), "vmin": 0, "vmax": 1, "rasterized": True}
        axes.pcolormesh(x, y, shown_occupancy(values), **look)
        handles = [
            Patch(fc="black", ec=INK, label="occupied"),
            Patch(fc="white", ec=INK, label="free"),
        ]
        p = 1 / (1 + np.exp(-np.abs(values)))
        if np.any((p > 0.5) & (p < 0.9)):
            handles.append(Patch(fc="0.5", ec=INK, label="in between"))
        if np.any(values == 0):
            handles.append(Patch(fc=_UNKNOWN, ec=INK, label="unknown"))
    else:
        mesh = axes.pcolormesh(x, y, values, cmap="viridis", rasterized=True)
        bar = figure.colorbar(mesh, ax=axes, shrink=0.8)
        bar.set_label(label, size=TEXT)
        bar.ax.tick_params(labelsize=TEXT)
        bar.outline.set_linewidth(0.6)
        handles = []
    for (name, other), color in zip((others or {}).items(), COLORS[1:], strict=False):
        axes.plot(*np.asarray(other)[:, :2].T, color=color, lw=0.7, label=name, zorder=4)
    if path is not None:
        axes.plot(*path[:, :2].T, color=COLORS[0], lw=1.2, label="path", zorder=3)
        end: Look = {
            "mfc": COLORS[0],
            "mec": "white",
            "ms": 5,
            "ls": "none",
            "label": "end",
        }
        axes.plot(*path[-1, :2], marker="o", zorder=5, **end)
    if beams is not None and path is not None:
        valid, angle = np.asarray(beams.returns()[0]), path[-1, 2] + np.asarray(beams.angle)
        far = np.asarray(beams.range)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        ends = (path[-1, :2] + far)[valid]
        both = np.stack([np.broadcast_to(path[-1, :2], ends.shape), ends], axis=1)
        for pair in both:
            axes.plot(*pair.T, color=FAINT, lw=0.3, alpha=0.6, zorder=2)
        axes.plot(*ends.T, ".", color=COLORS[1], ms=2.5, label="beams", zorder=4)
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    drawn = every_handle([axes])
    caption(figure, title, [*handles, *drawn]) if handles or drawn or title else None
    return figure


def shades_of_occupancy() -> Colormap:
    """The colour map of occupancy: white is free, black occupied, and a third colour unknown."""
    shades = LinearSegmentedColormap.from_list("occupancy", ["white", "black"])
    return shades.with_extremes(bad=_UNKNOWN)


def shown_occupancy(log_odds: np.ndarray) -> np.ma.MaskedArray:
    """The probability of each cell, masked where it is unknown."""
    return np.ma.masked_array(0.5 * (1 + np.tanh(log_odds / 2)), mask=log_odds == 0)


def world_of(
    origin: np.ndarray, resolution: float, x: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The world coordinates [m] of coordinates in cells."""
    c, s = np.cos(origin[2]), np.sin(origin[2])
    return origin[0] + resolution * (c * x - s * y), origin[1] + resolution * (s * x + c * y)
