"""The figure of a graph before and after, and the film of the iterations."""

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path

import jax
import numpy as np

from jaxslam import graphs
from jaxslam.cli import films
from jaxslam.consistency.campaign.progress import Progress
from jaxslam.graphs import Graph
from jaxslam.graphs.factor import Factor
from jaxslam.results.files import Files

WORST = 10
"""Number of rows with the largest residuals in the summary and the figure."""

FRAMES = 60
"""Number of iterations that a film shows at most."""


def figure_writer(
    options: argparse.Namespace,
    before: Graph,
    after: Graph,
    squared: Mapping[str, np.ndarray],
    subtitles: tuple[str, str],
) -> Callable[[Path], object]:
    """The function that draws the graph before and after into a file."""
    from jaxslam.results import plot  # matplotlib is slow to load

    title = Path(options.path).name
    edges = sum(int(table.valid.sum()) for table in after.tables.values())
    figure = plot.graph_figure(
        before,
        after,
        squared,
        worst=WORST,
        subtitles=subtitles,
        title=f"{title}: {len(after.poses):,} poses, {edges:,} edges",
    )
    return lambda path: path.write_bytes(plot.png(figure))


def film_writers(
    options: argparse.Namespace,
    begun: Graph,
    factors: Mapping[str, Factor],
    kernel: Mapping[str, graphs.Kernel] | None,
    solution: graphs.Solution,
) -> Files:
    """The functions that write the film of the iterations, by file name.

    Iterate k is where the same optimization stops after k steps; the limit is no part of the
    compiled program.
    """
    from jaxslam.results import plot  # matplotlib is slow to load

    taken = int(solution.iterations)
    shown = np.unique(np.linspace(1, taken, min(taken, FRAMES)).round().astype(int)).tolist()
    iterates, costs = [begun], [float(solution.chi2_start)]
    with Progress(f"{Path(options.path).name}: film", "iterations") as progress:
        for done, steps in enumerate(shown):
            at = graphs.optimize(begun, factors, kernel=kernel, iterations=steps)
            iterates.append(jax.tree.map(np.asarray, at.graph))
            costs.append(float(at.chi2))
            progress(done + 1, len(shown))
    note = "" if len(shown) == taken else f"{len(shown)} of {taken} iterations shown"
    scene = plot.graph_scene(
        iterates,
        costs,
        steps=[0, *shown],
        factors=factors,
        title=Path(options.path).name,
        note=note,
    )
    return films.film_files({"optimize": plot.Film(scene, fps=2.0)}, suffixed=False)


def as_text(value: object) -> str:
    """A value as it is printed; numbers with nine digits, so that optima can be compared."""
    if isinstance(value, dict):
        return ", ".join(f"{key} {count:,}" for key, count in value.items()) or "none"
    if value is None:
        return "not finite"
    return f"{value:.9g}" if isinstance(value, float) else str(value)
