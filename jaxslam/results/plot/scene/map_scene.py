"""The film of a map that grows."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from jaxslam.results.plot.maps.grids import shades_of_occupancy, shown_occupancy
from jaxslam.results.plot.scene.film import Draw, Layer, Panel, Scene
from jaxslam.results.plot.scene.layers import triangle
from jaxslam.results.plot.style import COLORS


def map_scene(
    log_odds: Sequence[Float[np.ndarray, "H W"]],
    origin: Float[np.ndarray, "3"],
    resolution: float,
    paths: Sequence[Float[np.ndarray, "n 3"]],
    said: Sequence[str],
    *,
    title: str = "",
) -> Scene:
    """The scene of F maps of one frame, each with the path that made it; the robot is at its end.

    Args:
        log_odds: of each map; 0 is unknown.
        origin: of the maps, without yaw. resolution: [m].
        paths: of each map, in the same order. said: the text of each.
    Raises:
        ValueError: without maps, other numbers of paths or texts, or a frame that is turned.
    """
    count = len(log_odds)
    if not count or {count} != {len(paths), len(said)}:
        raise ValueError(
            f"map_scene: expected as many paths and texts as maps, at least 1, got {count} maps, "
            f"{len(paths)} paths and {len(said)} texts"
        )
    if origin[2] != 0:
        raise ValueError(f"map_scene: expected an origin without yaw, got {origin[2]} rad")
    height, width = log_odds[0].shape
    x = float(origin[0]), float(origin[0] + resolution * width)
    y = float(origin[1]), float(origin[1] + resolution * height)
    ends = np.stack([path[-1] for path in paths])
    size = 0.03 * max(x[1] - x[0], y[1] - y[0])
    robot = triangle(ends, size, fc=COLORS[0], ec="white", lw=0.6, zorder=5)
    layers = [_image(log_odds, (*x, *y)), _path(paths), robot]
    return Scene(count, Panel(layers, x, y), None, lambda k: said[k], title)


def _image(
    log_odds: Sequence[Float[np.ndarray, "H W"]], extent: tuple[float, float, float, float]
) -> Layer:
    def layer(axes: Axes) -> Draw:
        axes.grid(visible=False)
        image = axes.imshow(
            shown_occupancy(log_odds[0]),
            extent=extent,
            origin="lower",
            interpolation="nearest",
            zorder=1,
            cmap=shades_of_occupancy(),
            vmin=0,
            vmax=1,
        )
        return lambda k: image.set_data(shown_occupancy(log_odds[k]))

    return layer


def _path(paths: Sequence[Float[np.ndarray, "n 3"]]) -> Layer:
    """The path of each frame: one that grows, or another one."""

    def layer(axes: Axes) -> Draw:
        (line,) = axes.plot([], [], color=COLORS[0], lw=1.0, label="path", zorder=3)
        return lambda k: line.set_data(*paths[k][:, :2].T)

    return layer
