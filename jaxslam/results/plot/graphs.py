"""The figure of a graph before and after its optimization, and the film of the iterates."""

from collections.abc import Mapping, Sequence

import numpy as np
from jax.typing import ArrayLike
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from jaxslam.graphs import Factor, Graph
from jaxslam.graphs.graph import successive
from jaxslam.graphs.solver.model import factors_of
from jaxslam.results.plot.film import Layer, Panel, Scene, lines_between, marks, still
from jaxslam.results.plot.style import (
    COLORS,
    FAINT,
    INK,
    PAGE,
    SHADE,
    Look,
    caption,
    every_handle,
    panels_of,
    titled,
)


def graph_figure(
    before: Graph,
    after: Graph,
    squared: Mapping[str, ArrayLike],
    *,
    factors: Mapping[str, Factor] | None = None,
    worst: int = 10,
    subtitles: tuple[str, str] = ("before", "after"),
    title: str = "",
    width: float = PAGE,
) -> Figure:
    """A graph before and after its optimization, side by side, with its worst residuals.

    Edges between poses of successive ids are the path, others are loop edges. Measurements of
    one variable alone are not drawn.

    Args:
        before, after: the same graph with different values.
        squared: eᵀ Ω e of each row after, of `graphs.squared_residuals`.
        factors: of the tables; by default those of files.
        worst: so many rows are marked in both panels: those of the largest eᵀ Ω e for its size.
        subtitles: of the panels. width: [in].
    """
    factors = factors_of("graph_figure", after, factors)
    figure, panels = panels_of(width, 0.52 * width, 1, 2, share=(False, False))
    marked = _worst(after, squared, factors, worst)
    for axes, graph, text in zip(panels, (before, after), subtitles, strict=True):
        _draw(axes, graph, factors, marked)
        titled(axes, text)
        axes.set_xlabel("x [m]")
    panels[0].set_ylabel("y [m]")
    caption(figure, title, every_handle(panels))
    return figure


def _worst(
    graph: Graph, squared: Mapping[str, ArrayLike], factors: Mapping[str, Factor], count: int
) -> dict[str, np.ndarray]:
    """The rows of each table that are marked: the largest, by residual and size of it."""
    found: dict[str, np.ndarray] = {key: np.zeros(0, int) for key in graph.tables}
    drawn = [key for key in graph.tables if len(factors[key].variables) == 2]
    ratio = [np.asarray(squared[key]) / len(factors[key].errors) for key in drawn]
    table = np.repeat(np.arange(len(drawn)), [len(each) for each in ratio])
    row = np.concatenate([np.zeros(0, int), *(np.arange(len(each)) for each in ratio)])
    every = np.concatenate([np.zeros(0), *ratio])
    largest = np.argsort(-every, kind="stable")[:count]
    largest = largest[every[largest] > 0]
    for i, key in enumerate(drawn):
        found[key] = row[largest[table[largest] == i]]
    return found


def _draw(
    axes: Axes, graph: Graph, factors: Mapping[str, Factor], marked: Mapping[str, np.ndarray]
) -> None:
    """Draw path, loop edges, points and what is marked."""
    poses, points = np.asarray(graph.poses)[:, :2], np.asarray(graph.points)
    bad = []
    for key, table in graph.tables.items():
        if len(factors[key].variables) != 2:
            continue
        who, valid = np.asarray(table.who), np.asarray(table.valid)
        between = factors[key].variables == ("pose", "pose")
        ends = np.stack([poses[who[:, 0]], (poses if between else points)[who[:, 1], :2]], axis=1)
        if between:
            steps = successive(graph, who)
            _lines(axes, ends[valid & ~steps], "loop edges", FAINT, 0.4, 2.0, alpha=0.5)
            _lines(axes, ends[valid & steps], "path", COLORS[0], 0.8, 3.0)
        else:
            _lines(axes, ends[valid], "measurements of points", SHADE, 0.3, 1.5, alpha=0.6)
        bad.append(ends[marked[key]])
    if len(points):
        axes.plot(*points[:, :2].T, ".", color=COLORS[2], ms=3, label="points", zorder=4)
    worst = np.concatenate([np.zeros((0, 2, 2)), *bad])
    if len(worst):
        axes.add_collection(LineCollection(list(worst), colors=COLORS[1], linewidths=1.4, zorder=5))
        ring: Look = {
            "ls": "none",
            "mfc": "none",
            "mec": COLORS[1],
            "mew": 0.9,
            "ms": 5,
            "zorder": 5,
        }
        label = f"{len(worst)} largest residuals"
        axes.plot(*worst.mean(axis=1).T, marker="o", label=label, **ring)
    start: Look = {
        "ls": "none",
        "color": INK,
        "mfc": "white",
        "mew": 1.2,
        "ms": 5,
        "zorder": 6,
    }
    axes.plot(*poses[0], marker="o", label="first pose", **start)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.04)


def _lines(
    axes: Axes, ends: np.ndarray, label: str, color: str, width: float, order: float, **more: float
) -> None:
    if len(ends):
        lines = LineCollection(
            list(ends), colors=color, linewidths=width, label=label, zorder=order, **more
        )
        axes.add_collection(lines)
        axes.update_datalim(ends.reshape(-1, 2))


def graph_scene(
    iterates: Sequence[Graph],
    chi2: Sequence[float],
    *,
    steps: Sequence[int] | None = None,
    factors: Mapping[str, Factor] | None = None,
    title: str = "",
    note: str = "",
) -> Scene:
    """The scene of one graph at each of F iterates: path, loop edges, points, and χ² in words.

    The last iterate stays in the background. Edges between poses of successive ids are the
    path, others are loop edges.

    Args:
        iterates: the same graph with different values, F of them.
        chi2: of each.
        steps: the number of the iteration of each; default 0, 1, …
        factors: of the tables; by default those of files.
    Raises:
        ValueError: without iterates, or another number of χ².
    """
    if not iterates or len(chi2) != len(iterates):
        raise ValueError(
            f"graph_scene: expected as many χ² as iterates, at least 1, got {len(chi2)} "
            f"and {len(iterates)}"
        )
    factors = factors_of("graph_scene", iterates[0], factors)
    poses = np.stack([np.asarray(graph.poses)[:, :2] for graph in iterates])
    points = np.stack([np.asarray(graph.points)[:, :2] for graph in iterates])
    found: dict[str, list[np.ndarray]] = {"path": [], "loop edges": [], "measurements": []}
    for key, table in iterates[0].tables.items():
        if len(factors[key].variables) != 2:
            continue
        who = np.asarray(table.who)[np.asarray(table.valid)]
        between = factors[key].variables == ("pose", "pose")
        other = (poses if between else points)[:, who[:, 1]]
        ends = np.stack([poses[:, who[:, 0]], other], axis=2)
        if not between:
            found["measurements"].append(ends)
            continue
        along = successive(iterates[0], who)
        found["path"].append(ends[:, along])
        found["loop edges"].append(ends[:, ~along])
    edges = {name: np.concatenate(each, axis=1) for name, each in found.items() if each}
    layers: list[Layer] = [still(poses[-1], color=SHADE, lw=2.5, label="path at the end", zorder=1)]
    for name, color, width, order in (
        ("measurements", SHADE, 0.4, 1.5),
        ("loop edges", FAINT, 0.5, 2.0),
        ("path", COLORS[0], 0.9, 3.0),
    ):
        if name in edges and edges[name].shape[1]:
            layers.append(
                lines_between(list(edges[name]), color=color, lw=width, label=name, zorder=order)
            )
    if points.shape[1]:
        shown = np.ones(points.shape[:2], bool)
        layers.append(
            marks(points, shown, marker=".", ms=3, color=COLORS[2], label="points", zorder=4)
        )
    first = np.ones((len(poses), 1), bool)
    layers.append(
        marks(poses[:, :1], first, marker="o", ms=5, mec=INK, mfc="white", label="first pose")
    )
    xlim, ylim = _limits(np.concatenate([poses, points], axis=1))

    def said(k: int) -> str:
        step = k if steps is None else steps[k]
        when = f"iteration {step}" if step else "start"
        return f"{when}, χ² = {chi2[k]:.6g}"

    return Scene(len(iterates), Panel(layers, xlim, ylim), None, said, title, note)


def _limits(places: np.ndarray) -> tuple[tuple[float, float], tuple[float, float]]:
    """Limits of x and y that hold the first and the last iterate, and of the others the bulk."""
    ends = places[[0, -1]].reshape(-1, 2)
    least = np.minimum(ends.min(axis=0), np.quantile(places.reshape(-1, 2), 0.01, axis=0))
    most = np.maximum(ends.max(axis=0), np.quantile(places.reshape(-1, 2), 0.99, axis=0))
    margin = 0.04 * max(float((most - least).max()), 1.0)
    (x0, y0), (x1, y1) = least - margin, most + margin
    return (float(x0), float(x1)), (float(y0), float(y1))
