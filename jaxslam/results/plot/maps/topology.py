"""The figure of a topological map over its grid."""

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import ArrayLike

from jaxslam.laser.topology import Route, TopologicalMap
from jaxslam.laser.topology.places import cell_centers
from jaxslam.results.plot.maps.grids import world_of
from jaxslam.results.plot.style import COLORS, INK, PAGE, Look, caption, every_handle, panels_of

_PALE = ("#cfe3f1", "#f8dcc8", "#cdebdf", "#f2dde9", "#f9e6c0", "#d9edf8", "#e3dccb", "#dcdcdc")


def topology_figure(
    places: TopologicalMap,
    *,
    route: Route | None = None,
    weights: ArrayLike | None = None,
    title: str = "",
    width: float = PAGE,
) -> Figure:
    """Places in colours, the skeleton with its junctions, doors, and the graph of places.

    Args:
        places: of `topology.topological_map`.
        route: drawn along the skeleton.
        weights: (P,) probability of each place, written beside its number.
        width: [in].
    """
    grid = places.grid
    label = places.label
    frame = np.asarray(grid.origin, float), float(np.asarray(grid.resolution))
    occupied = np.asarray(grid.log_odds) > 0
    there = np.nonzero((label >= 0) | occupied)  # the rest of the map is not shown
    part = tuple(slice(k.min(), k.max() + 1) for k in there)
    rows, columns = (np.arange(k.start, k.stop + 1) for k in part)
    x, y = world_of(*frame, columns[None, :] + 0.0 * rows[:, None], rows[:, None] + 0.0 * columns)
    height = (width - 0.6) * np.ptp(y) / np.ptp(x) + 0.9
    figure, (axes,) = panels_of(width, min(height, 9.0), 1)
    axes.grid(visible=False)
    colours = ListedColormap(_PALE)
    mesh: Look = {"rasterized": True, "zorder": 0}
    shown = np.ma.masked_array(_coloured(places)[label], mask=label < 0)
    axes.pcolormesh(x, y, shown[part], cmap=colours, vmin=-0.5, vmax=len(_PALE) - 0.5, **mesh)
    walls = np.ma.masked_array(np.ones(label.shape), mask=~occupied)
    black = ListedColormap(["#555555"])
    axes.pcolormesh(x, y, walls[part], cmap=black, **mesh)
    where = cell_centers(grid)
    skeleton = where[places.skeleton.cells.reshape(-1)]
    axes.plot(*skeleton.T, ".", color=INK, ms=1.0, label="skeleton", zorder=2)
    junctions = where[places.skeleton.junctions.reshape(-1)]
    axes.plot(*junctions.T, "o", color=INK, mfc="white", ms=3.5, label="junctions", zorder=4)
    name = "adjacent"
    for door in places.doors:
        for place in door.places:
            pair = np.stack([places.center[place], door.position])
            axes.plot(*pair.T, color=COLORS[0], lw=1.0, ls=(0, (4, 2)), label=name, zorder=3)
            name = "_"
    at = np.array([door.position for door in places.doors]).reshape(-1, 2)
    axes.plot(*at.T, "s", color=COLORS[1], mec="white", ms=6, ls="none", label="doors", zorder=5)
    if route is not None:
        axes.plot(*route.path.T, color=COLORS[2], lw=2.0, label="route", zorder=4.5)
    for k, (px, py) in enumerate(places.center):
        share = "" if weights is None else f": {float(np.asarray(weights)[k]):.0%}"
        box = {"boxstyle": "round,pad=0.25", "fc": "white", "ec": COLORS[0], "lw": 0.8}
        axes.text(px, py, f"{k}{share}", size=8, ha="center", va="center", bbox=box, zorder=6)
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    caption(figure, title, [Patch(fc="#555555", label="walls"), *every_handle([axes])])
    return figure


def _coloured(places: TopologicalMap) -> np.ndarray:
    """A colour for each place, another one than its neighbours', where there are enough."""
    adjacent, colour = places.adjacent, np.full(len(places.center) + 1, -1)
    for k in np.argsort(-adjacent.sum(axis=1), kind="stable"):
        taken = set(colour[:-1][adjacent[k]])
        free = [c for c in range(len(_PALE)) if c not in taken]
        used = np.bincount(colour[colour >= 0], minlength=len(_PALE))
        colour[k] = min(free, key=lambda c: (used[c], c)) if free else k % len(_PALE)
    return colour
