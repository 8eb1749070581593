"""The figure of laser SLAM: its path before and after closing, with the loops."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from jaxslam.laser_slam import LoopOutcome, Solved
from jaxslam.results.plot.style import (
    COLORS,
    FAINT,
    INK,
    PAGE,
    caption,
    every_handle,
    panels_of,
    titled,
)


def loops_figure(
    solved: Solved,
    reference: ArrayLike | None = None,
    *,
    title: str = "",
    width: float = PAGE,
) -> Figure:
    """The paths of laser odometry and after closing, side by side, with the loops that were kept.

    reference: (K, 3) poses, drawn in grey; they are carried to the first pose. width: [in].
    """
    figure, panels = panels_of(width, 0.55 * width, 1, 2, share=(True, True))
    kept = solved.loops.outcome == LoopOutcome.KEPT
    ends = np.stack([solved.loops.first[kept], solved.loops.second[kept]], axis=1)
    paths = (solved.odometry, "laser odometry"), (solved.poses, "after closing")
    for axes, (path, text) in zip(panels, paths, strict=True):
        _draw(axes, path[:, :2], ends, None if reference is None else np.asarray(reference))
        titled(axes, text)
        axes.set_xlabel("x [m]")
    panels[0].set_ylabel("y [m]")
    caption(figure, title, every_handle(panels))
    return figure


def _draw(axes: Axes, path: np.ndarray, ends: np.ndarray, reference: np.ndarray | None) -> None:
    if reference is not None:
        axes.plot(*reference[:, :2].T, color=FAINT, lw=1.6, label="reference", zorder=1)
    loops: Any = list(path[ends])
    lines = LineCollection(
        loops, colors=COLORS[1], linewidths=0.5, alpha=0.6, label="loops", zorder=2
    )
    axes.add_collection(lines)
    axes.plot(*path.T, color=COLORS[0], lw=0.8, label="path", zorder=3)
    start: dict[str, Any] = {"ls": "none", "color": INK, "mfc": "white", "mew": 1.2, "ms": 5}
    axes.plot(*path[0], marker="o", label="first pose", zorder=4, **start)
    axes.set_aspect("equal", adjustable="datalim")
