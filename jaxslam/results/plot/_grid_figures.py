"""Figures of occupancy grids, laser SLAM and topological maps; the film of a map that grows."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.collections import LineCollection
from matplotlib.colors import Colormap, LinearSegmentedColormap, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Polygon
from numpy.typing import ArrayLike

from jaxslam.consistency.metrics import ate
from jaxslam.consistency.metrics._paths import transform
from jaxslam.core.types import Beams
from jaxslam.core.validation import InvalidField, refusals_of
from jaxslam.laser.grids import Field, Grid
from jaxslam.laser.laser_slam import LoopOutcome, Solved
from jaxslam.laser.topology import Route, TopologicalMap
from jaxslam.laser.topology._places import cell_centers
from jaxslam.results.plot._film import Film, robot_at, stage
from jaxslam.results.plot._style import (
    COLORS,
    FAINT,
    INK,
    PAGE,
    TEXT,
    Look,
    caption,
    every_handle,
    own_settings,
    panels_of,
    titled,
)

_UNKNOWN = "#c9d3dd"
"""Colour of unknown cells, not a shade of grey."""


@own_settings()
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
    """The map: occupied cells black, free ones white, unknown ones in a third colour.

    Args:
        grid: a map; or a `Field`, as a distance field, whose values are shown in colours.
        poses: (T, 2 or 3) drawn as a path with its end.
        beams: a scan from the last pose.
        others: other paths by name, drawn thin, as a reference.
        label: text beside the scale of a field.
        width: width of the figure [in].
    Raises:
        ValueError: beams without poses of three numbers.
    """
    path = None if poses is None else np.atleast_2d(np.asarray(poses))
    if beams is not None and (path is None or path.shape[1] != 3):
        raise InvalidField("", "beams are from the last of poses (x, y, θ)", owner="grid_figure")
    values = np.asarray(grid[0])
    x, y = _corners(grid, *(np.arange(n + 1) for n in values.shape))
    inner = width - (0.6 if isinstance(grid, Grid) else 1.3)  # beside labels, or a scale, too
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
    for (name, reference), color in zip((others or {}).items(), COLORS[1:], strict=False):
        axes.plot(*np.asarray(reference)[:, :2].T, color=color, lw=0.7, label=name, zorder=4)
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
    """The probability of each cell; unknown cells are masked."""
    # 1 / (1 + exp(-l)), which does not overflow.
    return np.ma.masked_array(0.5 * (1 + np.tanh(log_odds / 2)), mask=log_odds == 0)


def _corners(
    grid: Grid | Field, rows: np.ndarray, columns: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The world coordinates [m] of the corners of cells, for `pcolormesh`."""
    x, y = np.meshgrid(columns, rows)
    origin, resolution = np.asarray(grid.origin, float), float(np.asarray(grid.resolution))
    c, s = np.cos(origin[2]), np.sin(origin[2])
    return origin[0] + resolution * (c * x - s * y), origin[1] + resolution * (s * x + c * y)


_PALE = ("#cfe3f1", "#f8dcc8", "#cdebdf", "#f2dde9", "#f9e6c0", "#d9edf8", "#e3dccb", "#dcdcdc")


@own_settings()
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
        places: result of `topology.topological_map`.
        route: drawn along the skeleton.
        weights: (P,) probability of each place, written beside its number.
        width: width of the figure [in].
    """
    grid = places.grid
    label = places.label
    occupied = np.asarray(grid.log_odds) > 0
    drawn = np.nonzero((label >= 0) | occupied)  # the rest of the map is left out
    part = tuple(slice(k.min(), k.max() + 1) for k in drawn)
    x, y = _corners(grid, *(np.arange(k.start, k.stop + 1) for k in part))
    height = (width - 0.6) * np.ptp(y) / np.ptp(x) + 0.9
    figure, (axes,) = panels_of(width, min(height, 9.0), 1)
    axes.grid(visible=False)
    colours = ListedColormap(_PALE)
    mesh: Look = {"rasterized": True, "zorder": 0}
    shown = np.ma.masked_array(_colors_of(places)[label], mask=label < 0)
    axes.pcolormesh(x, y, shown[part], cmap=colours, vmin=-0.5, vmax=len(_PALE) - 0.5, **mesh)
    walls = np.ma.masked_array(np.ones(label.shape), mask=~occupied)
    black = ListedColormap(["#555555"])
    axes.pcolormesh(x, y, walls[part], cmap=black, **mesh)
    centers = cell_centers(grid)
    skeleton = centers[places.skeleton.cells.reshape(-1)]
    axes.plot(*skeleton.T, ".", color=INK, ms=1.0, label="skeleton", zorder=2)
    junctions = centers[places.skeleton.junctions.reshape(-1)]
    axes.plot(*junctions.T, "o", color=INK, mfc="white", ms=3.5, label="junctions", zorder=4)
    label_once = "adjacent"
    for door in places.doors:
        for place in door.places:
            pair = np.stack([places.center[place], door.position])
            axes.plot(*pair.T, color=COLORS[0], lw=1.0, ls=(0, (4, 2)), label=label_once, zorder=3)
            label_once = "_"
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


def _colors_of(places: TopologicalMap) -> np.ndarray:
    """The colour of each place, different from its neighbours' if there are enough; then -1.

    Greedily, places with most neighbours first; of the free colours the least used one.
    """
    adjacent, color = places.adjacent, np.full(len(places.center) + 1, -1)
    for k in np.argsort(-adjacent.sum(axis=1), kind="stable"):
        of_neighbors = set(color[:-1][adjacent[k]])
        free = [c for c in range(len(_PALE)) if c not in of_neighbors]
        uses = np.bincount(color[color >= 0], minlength=len(_PALE))
        color[k] = min(free, key=lambda c: (uses[c], c)) if free else k % len(_PALE)
    return color  # the entry -1 is for cells without a place, whose label is -1


CELLS = 400
"""Largest number of cells along a side of a map as it is drawn: walls of one cell stay visible."""


@own_settings()
def loops_figure(
    solved: Solved,
    reference: ArrayLike | None = None,
    *,
    title: str = "",
    width: float = PAGE,
) -> Figure:
    """The paths of laser odometry and after closing, side by side, with the loops that were kept.

    Args:
        solved: result of `laser_slam.solve`.
        reference: (K, 3) poses, drawn in grey, aligned with each path.
        width: width of the figure [in].
    """
    across, up = np.ptp(solved.poses[:, :2], axis=0) + 1e-6
    height = 0.46 * width * float(np.clip(up / across, 0.4, 1.5)) + 0.9
    figure, panels = panels_of(width, height, 1, 2, share=(False, False))
    kept = solved.loops.outcome == LoopOutcome.KEPT
    ends = np.stack([solved.loops.first[kept], solved.loops.second[kept]], axis=1)
    paths = (solved.odometry, "laser odometry"), (solved.poses, "after closing")
    for axes, (path, text) in zip(panels, paths, strict=True):
        points = path[:, :2]
        if reference is not None:
            aligned = transform(ate(path, np.asarray(reference)).frame, np.asarray(reference))
            axes.plot(*aligned[:, :2].T, color=FAINT, lw=1.6, label="reference", zorder=1)
        lines: Look = {"colors": COLORS[1], "linewidths": 1.2, "alpha": 0.8, "zorder": 3.5}
        axes.add_collection(LineCollection(list(points[ends]), label="loops", **lines))
        axes.plot(*points.T, color=COLORS[0], lw=0.8, label="path", zorder=3)
        start: Look = {"ls": "none", "color": INK, "mfc": "white", "mew": 1.2, "ms": 5}
        axes.plot(*points[0], marker="o", label="first pose", zorder=4, **start)
        axes.set_aspect("equal", adjustable="datalim")
        titled(axes, text)
        axes.set_xlabel("x [m]")
    panels[0].set_ylabel("y [m]")
    caption(figure, title, every_handle(panels))
    return figure


@own_settings()
def maps_before_after(solved: Solved, *, title: str = "", width: float = PAGE) -> Figure:
    """The maps of laser odometry alone and after closing, side by side. width: [in]."""
    cells = np.argwhere(np.asarray(solved.map.observed) | np.asarray(solved.map_before.observed))
    if not len(cells):
        cells = np.array([[0, 0]])
    low, high = cells.min(axis=0), cells.max(axis=0) + 1
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
    padded = np.zeros((rows, columns))
    padded[: log_odds.shape[0], : log_odds.shape[1]] = log_odds
    blocks = padded.reshape(rows // block, block, columns // block, block)  # cells on axes 1 and 3
    largest, smallest = blocks.max(axis=(1, 3)), blocks.min(axis=(1, 3))
    odds = np.where(largest > 0, largest, smallest)  # an occupied cell decides
    return np.where(odds == 0, 0.8, 0.5 * (1 - np.tanh(0.5 * odds)))


@own_settings()
def map_film(
    log_odds: Sequence[Float[np.ndarray, "H W"]],
    origin: Float[np.ndarray, "3"],
    resolution: float,
    paths: Sequence[Float[np.ndarray, "n 3"]],
    captions: Sequence[str],
    *,
    title: str = "",
) -> Film:
    """The film of F maps of one frame, each with the path that made it; the robot is at its end.

    Args:
        log_odds: cells of each map; 0 is unknown.
        origin: origin of the maps, without yaw.
        resolution: side of a cell [m].
        paths: the path of each map.
        captions: the text of each map.
    Raises:
        ValueError: without maps, other numbers of paths or captions, or a rotated frame.
    """
    count = len(log_odds)
    with refusals_of("map_film"):
        if not count or {count} != {len(paths), len(captions)}:
            raise InvalidField(
                "",
                f"expected as many paths and texts as maps, at least 1, got {count} maps, "
                f"{len(paths)} paths and {len(captions)} captions",
            )
        if origin[2] != 0:
            raise InvalidField("", f"expected an origin without yaw, got {origin[2]} rad")
    height, width = log_odds[0].shape
    x = float(origin[0]), float(origin[0] + resolution * width)
    y = float(origin[1]), float(origin[1] + resolution * height)
    size = 0.03 * max(x[1] - x[0], y[1] - y[0])
    figure, (axes, _) = stage(x, y)
    axes.grid(visible=False)
    cells = axes.imshow(
        shown_occupancy(log_odds[0]),
        extent=(*x, *y),
        origin="lower",
        interpolation="nearest",
        zorder=1,
        cmap=shades_of_occupancy(),
        vmin=0,
        vmax=1,
    )
    (line,) = axes.plot([], [], color=COLORS[0], lw=1.0, label="path", zorder=3)
    robot = Polygon(np.zeros((3, 2)), closed=True, fc=COLORS[0], ec="white", lw=0.6, zorder=5)
    axes.add_patch(robot)

    def update(k: int) -> str:
        cells.set_data(shown_occupancy(log_odds[k]))
        line.set_data(*paths[k][:, :2].T)
        robot.set_xy(robot_at(paths[k][-1], size))
        return captions[k]

    return Film(figure, update, count, title=title)
