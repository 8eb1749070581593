"""The film of an optimization: a graph at each of its iterates."""

from collections.abc import Mapping, Sequence

import numpy as np

from jaxslam.graphs import Factor, Graph
from jaxslam.graphs.graph import successive
from jaxslam.graphs.solver.model import factors_of
from jaxslam.results.plot.scene.film import Layer, Panel, Scene
from jaxslam.results.plot.scene.layers import lines_between, marks, still
from jaxslam.results.plot.style import COLORS, FAINT, INK, SHADE


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
