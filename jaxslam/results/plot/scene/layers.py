"""Layers of many films: paths, marks, triangles, ellipses, segments, clouds of particles.

Each takes what it shows for all F frames, and how it looks; `look` goes to Matplotlib.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.patches import Polygon

from jaxslam.results.plot.maps.geometry import ellipses
from jaxslam.results.plot.scene.film import Draw, Layer

_TRIANGLE = np.array([[1.0, 0.0], [-0.6, 0.55], [-0.6, -0.55]])


def still(points: Float[np.ndarray, "N 2"], **look: Any) -> Layer:
    """The layer of points that are the same in all frames."""

    def layer(axes: Axes) -> Draw:
        axes.plot(*np.asarray(points).T, **look)
        return lambda k: None

    return layer


def track(path: Float[np.ndarray, "T C"], until: Int[np.ndarray, "F"], **look: Any) -> Layer:
    """The layer of a path that grows: in frame k its points up to until[k]; NaN interrupts it."""

    def layer(axes: Axes) -> Draw:
        (line,) = axes.plot([], [], **look)
        return lambda k: line.set_data(*path[: until[k] + 1, :2].T)

    return layer


def marks(points: Float[np.ndarray, "F N 2"], shown: Bool[np.ndarray, "F N"], **look: Any) -> Layer:
    """The layer of points that are others in each frame."""

    def layer(axes: Axes) -> Draw:
        (line,) = axes.plot([], [], ls="none", **look)
        return lambda k: line.set_data(*points[k][shown[k]].T)

    return layer


def triangle(poses: Float[np.ndarray, "F 3"], size: float, **look: Any) -> Layer:
    """The layer of a robot: a triangle, `size` long from its position to its tip."""

    def layer(axes: Axes) -> Draw:
        patch = Polygon(size * _TRIANGLE, closed=True, **look)
        axes.add_patch(patch)

        def draw(k: int) -> None:
            x, y, heading = poses[k]
            cosine, sine = np.cos(heading), np.sin(heading)
            turn = np.array([[cosine, sine], [-sine, cosine]])
            patch.set_visible(bool(np.isfinite(poses[k]).all()))
            patch.set_xy(np.array([x, y]) + size * _TRIANGLE @ turn)

        return draw

    return layer


def rings(
    means: Float[np.ndarray, "F N 2"],
    covs: Float[np.ndarray, "F N 2 2"],
    shown: Bool[np.ndarray, "F N"],
    **look: Any,
) -> Layer:
    """The layer of 3 σ ellipses that grow and shrink; a covariance that has none is left out."""

    def layer(axes: Axes) -> Draw:
        (line,) = axes.plot([], [], **look)

        def draw(k: int) -> None:
            contours = ellipses(means[k][shown[k]], covs[k][shown[k]], points=48)
            line.set_data(*_apart(contours).T)

        return draw

    return layer


def lines_between(ends: Sequence[Float[np.ndarray, "E 2 2"]], **look: Any) -> Layer:
    """The layer of lines between two points each, others in every frame."""

    def layer(axes: Axes) -> Draw:
        (line,) = axes.plot([], [], **look)
        return lambda k: line.set_data(*_apart(ends[k]).T)

    return layer


def weighted_segments(
    ends: Sequence[Float[np.ndarray, "E 2 2"]],
    weights: Sequence[Float[np.ndarray, "E"]],
    *,
    color: str,
    width: float,
    **look: Any,
) -> Layer:
    """The layer of lines with weights from 0 to 1: light ones are thin and pale.

    width: of a line of weight 1 [pt].
    """

    def layer(axes: Axes) -> Draw:
        lines = LineCollection([], color=color, linewidth=width, **look)
        axes.add_collection(lines, autolim=False)

        def draw(k: int) -> None:
            heavy = np.sqrt(weights[k])
            lines.set_segments(list(ends[k]))
            lines.set_linewidth(list(width * (0.15 + 0.85 * heavy)))
            lines.set_color([to_rgba(color, 0.2 + 0.6 * each) for each in heavy])

        return draw

    return layer


def cloud(
    points: Float[np.ndarray, "F P 2"], weight: Float[np.ndarray, "F P"], **look: Any
) -> Layer:
    """The layer of particles, with areas by their weights; one of weight zero is left out."""
    areas = 4.0 * weight * weight.shape[1]

    def layer(axes: Axes) -> Draw:
        dots = axes.scatter([], [], **look)

        def draw(k: int) -> None:
            there = weight[k] > 0
            dots.set_offsets(points[k][there])
            dots.set_sizes(np.clip(areas[k][there], 0.5, 60.0))

        return draw

    return layer


def _apart(lines: Float[np.ndarray, "E C 2"]) -> Float[np.ndarray, "D 2"]:
    """Lines one after the other, with NaN between them: as one line they are drawn at once."""
    gap = np.full((len(lines), 1, 2), np.nan)
    return np.concatenate([lines, gap], axis=1).reshape(-1, 2)
