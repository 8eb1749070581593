"""The figure of laser SLAM: its path before and after closing, with the loops."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from jaxslam.consistency.metrics import ate, carried
from jaxslam.laser.laser_slam import LoopOutcome, Solved
from jaxslam.results.plot.style import (
    COLORS,
    FAINT,
    INK,
    PAGE,
    Look,
    caption,
    every_handle,
    panels_of,
    titled,
)

CELLS = 400
"""along a side of a map as drawn: walls of one cell stay visible"""


def loops_figure(
    solved: Solved,
    reference: ArrayLike | None = None,
    *,
    title: str = "",
    width: float = PAGE,
) -> Figure:
    """The paths of laser odometry and after closing, side by side, with the loops that were kept.

    reference: (K, 3) poses, drawn in grey, aligned with each path. width: [in].
    """
    across, up = np.ptp(solved.poses[:, :2], axis=0) + 1e-6
    height = 0.46 * width * float(np.clip(up / across, 0.4, 1.5)) + 0.9
    figure, panels = panels_of(width, height, 1, 2, share=(False, False))
    kept = solved.loops.outcome == LoopOutcome.KEPT
    ends = np.stack([solved.loops.first[kept], solved.loops.second[kept]], axis=1)
    paths = (solved.odometry, "laser odometry"), (solved.poses, "after closing")
    for axes, (path, text) in zip(panels, paths, strict=True):
        known = None
        if reference is not None:
            known = carried(ate(path, np.asarray(reference)).frame, np.asarray(reference))
        _draw(axes, path[:, :2], ends, known)
        titled(axes, text)
        axes.set_xlabel("x [m]")
    panels[0].set_ylabel("y [m]")
    caption(figure, title, every_handle(panels))
    return figure


def _draw(axes: Axes, path: np.ndarray, ends: np.ndarray, reference: np.ndarray | None) -> None:
    if reference is not None:
        axes.plot(*reference[:, :2].T, color=FAINT, lw=1.6, label="reference", zorder=1)
    lines = LineCollection(
        list(path[ends]), colors=COLORS[1], linewidths=1.2, alpha=0.8, label="loops", zorder=3.5
    )
    axes.add_collection(lines)
    axes.plot(*path.T, color=COLORS[0], lw=0.8, label="path", zorder=3)
    start: Look = {"ls": "none", "color": INK, "mfc": "white", "mew": 1.2, "ms": 5}
    axes.plot(*path[0], marker="o", label="first pose", zorder=4, **start)
    axes.set_aspect("equal", adjustable="datalim")


def maps_before_after(solved: Solved, *, title: str = "", width: float = PAGE) -> Figure:
    """The maps of laser odometry alone and after closing, side by side. width: [in]."""
    known = np.argwhere(np.asarray(solved.map.known) | np.asarray(solved.map_before.known))
    if not len(known):
        known = np.array([[0, 0]])
    low, high = known.min(axis=0), known.max(axis=0) + 1
    height = min(0.46 * width * float((high - low)[0] / (high - low)[1]), 9.0) + 0.7
    figure, panels = panels_of(width, height, 1, 2, share=(False, False))
    maps = (solved.map_before, "laser odometry"), (solved.map, "after closing")
    for axes, (grid, text) in zip(panels, maps, strict=True):
        seen = np.asarray(grid.log_odds)[low[0] : high[0], low[1] : high[1]]
        shade = _shade(seen, int(np.ceil(max(seen.shape) / CELLS)))
        left, down = np.asarray(grid.origin)[:2] + float(grid.resolution) * low[::-1]
        right, up = np.asarray(grid.origin)[:2] + float(grid.resolution) * high[::-1]
        axes.grid(visible=False)
        axes.imshow(
            shade, cmap="gray", vmin=0, vmax=1, origin="lower", extent=(left, right, down, up)
        )
        titled(axes, text)
        axes.set_xlabel("x [m]")
    panels[0].set_ylabel("y [m]")
    if title:
        caption(figure, title, [])
    return figure


def _shade(log_odds: np.ndarray, block: int) -> np.ndarray:
    """The image of a map by blocks of cells: white is free, black has a wall, grey is unknown."""
    rows, columns = (-(-n // block) * block for n in log_odds.shape)
    whole = np.zeros((rows, columns))
    whole[: log_odds.shape[0], : log_odds.shape[1]] = log_odds
    parts = whole.reshape(rows // block, block, columns // block, block)
    most, least = parts.max(axis=(1, 3)), parts.min(axis=(1, 3))
    odds = np.where(most > 0, most, least)
    return np.where(odds == 0, 0.8, 0.5 * (1 - np.tanh(0.5 * odds)))
