"""The figure of a map whose landmarks are the walls' lines."""

import numpy as np
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from jaxslam.core.types import Estimate
from jaxslam.results.plot.style import COLORS, INK, PAGE, caption, every_handle, panels_of
from jaxslam.simulation.walls import Walls, wall_lines


def walls_figure(
    estimate: Estimate,
    walls: Walls,
    *,
    path: ArrayLike | None = None,
    n_sigma: float = 3.0,
    title: str = "",
    width: float = PAGE,
) -> Figure:
    """The map of an EKF of `sensors.Line`: each true wall where its estimated line has it.

    A segment of the walls is projected onto the line with its tag, and drawn with the band of the
    line's n_sigma across it. Walls that were not measured are the true ones alone.

    Args:
        estimate: (T, …); the map is the last one. Tags are those of `simulation.walls.wall_lines`.
        walls: true ones, in the frame of the map.
        path: (T, 2 or 3) true one.
    Raises:
        ValueError: if the walls have no segments, or a tag is none of theirs.
    """
    of = wall_lines(walls)[1]
    alive = np.asarray(estimate.alive[-1])
    tags = np.asarray(estimate.tag[-1])[alive]
    if len(tags) and not (tags.min() >= 0 and tags.max() <= of.max()):
        raise ValueError(f"walls_figure: expected tags from 0 to {of.max()}, got {tags}")
    feet = np.asarray(estimate.points[-1])[alive]
    covs = np.asarray(estimate.point_covs[-1])[alive]
    ends, bands = [], []
    for tag, foot, cov in zip(tags, feet, covs, strict=True):
        r = np.hypot(*foot)
        normal = foot / r
        along = np.array([-normal[1], normal[0]])
        for segment in np.asarray(walls.segments)[of == tag]:
            at = segment @ along
            across = r * normal[None] + at[:, None] * along[None]
            # The line is off by dr - at dα there, and the foot by (dr, r dα) in the line's frame.
            slope = normal[None] - (at / r)[:, None] * along[None]
            sigma = n_sigma * np.sqrt(np.einsum("ki,ij,kj->k", slope, cov, slope))
            off = sigma[:, None] * normal[None]
            ends.append(across)
            bands.append(np.concatenate([across + off, (across - off)[::-1]]))
    segments = np.asarray(walls.segments)
    low, high = segments.reshape(-1, 2).min(axis=0), segments.reshape(-1, 2).max(axis=0)
    inner = width - 0.6
    height = inner * (high - low)[1] / (high - low)[0] + 0.9
    figure, (axes,) = panels_of(width, min(height, 9.0), 1)
    axes.grid(visible=False)
    axes.add_collection(
        LineCollection(list(segments), color=INK, lw=2.2, alpha=0.45, label="walls")
    )
    band = f"{n_sigma:g} σ of a line"
    axes.add_collection(PolyCollection(bands, color=COLORS[1], alpha=0.25, lw=0, label=band))
    axes.add_collection(
        LineCollection(ends, color=COLORS[1], lw=0.9, label="estimated lines", zorder=3)
    )
    if path is not None:
        true = np.asarray(path)
        axes.plot(*true[:, :2].T, color=INK, lw=1.0, ls=(0, (4, 2)), label="true path", zorder=3.5)
    pose = np.asarray(estimate.pose)
    axes.plot(*pose[:, :2].T, color=COLORS[0], lw=1.2, label="estimated path", zorder=4)
    axes.plot(*pose[0, :2], "o", color=INK, mfc="white", mew=1.2, ms=5, label="start", zorder=5)
    margin = 0.03 * (high - low).max()
    axes.set(
        xlabel="x [m]",
        ylabel="y [m]",
        aspect="equal",
        xlim=(low[0] - margin, high[0] + margin),
        ylim=(low[1] - margin, high[1] + margin),
    )
    caption(figure, title, every_handle([axes]))
    return figure
