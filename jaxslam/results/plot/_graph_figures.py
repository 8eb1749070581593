"""The figure of a graph before and after its optimization, and the film of the iterates."""

from collections.abc import Mapping, Sequence

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from jaxslam.core.validation import InvalidField, refusals_of
from jaxslam.graphs import Factor, Graph
from jaxslam.graphs._graph import is_successive
from jaxslam.graphs._solver.model import factors_of
from jaxslam.results.plot._film import Film, joined, stage
from jaxslam.results.plot._style import (
    COLORS,
    FAINT,
    INK,
    PAGE,
    SHADE,
    Look,
    caption,
    every_handle,
    own_settings,
    panels_of,
    titled,
)

_EDGES: dict[str, Look] = {
    "measurements of points": {"color": SHADE, "lw": 0.4, "zorder": 1.5},
    "loop edges": {"color": FAINT, "lw": 0.5, "zorder": 2.0},
    "path": {"color": COLORS[0], "lw": 0.9, "zorder": 3.0},
}
"""Looks of edges; the path is between poses of successive ids."""


@own_settings()
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
        before: the graph before the optimization.
        after: the same graph with the optimized values.
        squared: eᵀ Ω e of each row after, from `graphs.squared_residuals`.
        factors: factors of the tables; by default those of files.
        worst: number of rows marked in both panels: those with the largest eᵀ Ω e for its size.
        subtitles: titles of the panels.
        width: width of the figure [in].
    """
    with refusals_of("graph_figure"):
        factors = factors_of(after, factors)
    ratios = [
        (float(value) / len(factors[key].errors), key, row)
        for key in _edge_tables(after, factors)
        for row, value in enumerate(np.asarray(squared[key]))
    ]
    positive = (row for row in ratios if row[0] > 0)
    largest = sorted(positive, key=lambda row: -row[0])[:worst]
    figure, panels = panels_of(width, 0.52 * width, 1, 2, share=(False, False))
    for axes, graph, text in zip(panels, (before, after), subtitles, strict=True):
        for name, ends in _edges(graph, factors).items():
            if len(ends):
                edges = LineCollection(list(ends), alpha=0.8, label=name, **_EDGES[name])
                axes.add_collection(edges)
                axes.update_datalim(ends.reshape(-1, 2))
        if len(graph.points):
            points = np.asarray(graph.points)[:, :2]
            axes.plot(*points.T, ".", color=COLORS[2], ms=3, label="points", zorder=4)
        start: Look = {"ls": "none", "color": INK, "mfc": "white", "mew": 1.2, "ms": 5, "zorder": 6}
        axes.plot(*np.asarray(graph.poses)[0, :2], marker="o", label="first pose", **start)
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.04)
        if largest:
            ends = np.array([_ends(graph, factors[key], key)[row] for _, key, row in largest])
            axes.add_collection(
                LineCollection(list(ends), colors=COLORS[1], linewidths=1.4, zorder=5)
            )
            ring: Look = {"ls": "none", "mfc": "none", "mec": COLORS[1], "mew": 0.9, "ms": 5}
            label = f"{len(ends)} largest residuals"
            axes.plot(*ends.mean(axis=1).T, marker="o", label=label, zorder=5, **ring)
        titled(axes, text)
        axes.set_xlabel("x [m]")
    panels[0].set_ylabel("y [m]")
    caption(figure, title, every_handle(panels))
    return figure


def _edge_tables(graph: Graph, factors: Mapping[str, Factor]) -> list[str]:
    """The names of the tables of edges between two variables."""
    return [key for key in graph.tables if len(factors[key].variables) == 2]


def _ends(graph: Graph, factor: Factor, key: str) -> Float[np.ndarray, "E 2 2"]:
    """The positions that the edges of a table join."""
    poses, who = np.asarray(graph.poses)[:, :2], np.asarray(graph.tables[key].who)
    second = poses if factor.variables == ("pose", "pose") else np.asarray(graph.points)[:, :2]
    return np.stack([poses[who[:, 0]], second[who[:, 1]]], axis=1)


def _edges(graph: Graph, factors: Mapping[str, Factor]) -> dict[str, Float[np.ndarray, "E 2 2"]]:
    """The ends of all edges, by the names of `_EDGES`."""
    ends_by_name = {name: [np.zeros((0, 2, 2))] for name in _EDGES}
    for key in _edge_tables(graph, factors):
        table, ends = graph.tables[key], _ends(graph, factors[key], key)
        valid = np.asarray(table.valid)
        if factors[key].variables == ("pose", "pose"):
            along = is_successive(graph, np.asarray(table.who))
            ends_by_name["path"].append(ends[valid & along])
            ends_by_name["loop edges"].append(ends[valid & ~along])
        else:
            ends_by_name["measurements of points"].append(ends[valid])
    return {name: np.concatenate(parts) for name, parts in ends_by_name.items()}


@own_settings()
def graph_film(
    iterates: Sequence[Graph],
    chi2: Sequence[float],
    *,
    steps: Sequence[int] | None = None,
    factors: Mapping[str, Factor] | None = None,
    title: str = "",
    note: str = "",
) -> Film:
    """The film of one graph at each of F iterates: path, loop edges, points, and χ² as text.

    The last iterate stays in the background. Edges between poses of successive ids are the
    path, others are loop edges.

    Args:
        iterates: F graphs that differ in their values alone.
        chi2: χ² of each iterate.
        steps: the number of the iteration of each iterate; default 0, 1, …
        factors: factors of the tables; by default those of files.
    Raises:
        ValueError: without iterates, or another number of χ².
    """
    if not iterates or len(chi2) != len(iterates):
        raise InvalidField(
            "",
            f"expected as many χ² as iterates, at least 1, got {len(chi2)} and {len(iterates)}",
            owner="graph_film",
        )
    with refusals_of("graph_film"):
        factors = factors_of(iterates[0], factors)
    poses = np.stack([np.asarray(graph.poses)[:, :2] for graph in iterates])
    points = np.stack([np.asarray(graph.points)[:, :2] for graph in iterates])
    edges = [_edges(graph, factors) for graph in iterates]
    # The limits hold the first and the last iterate, and of the others the bulk: a diverging
    # iterate leaves the panel.
    positions = np.concatenate([poses, points], axis=1)
    ends, bulk = positions[[0, -1]].reshape(-1, 2), positions.reshape(-1, 2)
    low = np.minimum(ends.min(axis=0), np.quantile(bulk, 0.01, axis=0))
    high = np.maximum(ends.max(axis=0), np.quantile(bulk, 0.99, axis=0))
    margin = 0.04 * max(float((high - low).max()), 1.0)
    x, y = ((float(a - margin), float(b + margin)) for a, b in zip(low, high, strict=True))
    figure, (axes, _) = stage(x, y)
    axes.plot(*poses[-1].T, color=SHADE, lw=2.5, label="path at the end", zorder=1)
    lines = {
        name: axes.plot([], [], label=name, **look)[0]
        for name, look in _EDGES.items()
        if len(edges[0][name])
    }
    look: Look = {"ls": "none", "marker": ".", "ms": 3, "color": COLORS[2], "zorder": 4}
    label = "points" if points.shape[1] else "_"
    (dots,) = axes.plot([], [], label=label, **look)
    look = {"ls": "none", "marker": "o", "ms": 5, "mec": INK, "mfc": "white"}
    (first,) = axes.plot([], [], label="first pose", **look)

    def update(k: int) -> str:
        for name, line in lines.items():
            line.set_data(*joined(edges[k][name]).T)
        dots.set_data(*points[k].T)
        first.set_data(*poses[k, :1].T)
        step = k if steps is None else steps[k]
        when = f"iteration {step}" if step else "start"
        return f"{when}, χ² = {chi2[k]:.6g}"

    return Film(figure, update, len(iterates), title=title, note=note, fps=2.0)
