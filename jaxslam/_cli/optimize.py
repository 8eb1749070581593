"""The command `jaxslam optimize`: the optimum of a graph in a file."""

import argparse
import sys
import time
from collections.abc import Collection, Mapping
from pathlib import Path

import jax
import numpy as np

from jaxslam import graphs
from jaxslam._cli import cache
from jaxslam._cli.common import (
    FILMS,
    SUMMARY,
    CompileClock,
    Drawings,
    add_animate,
    add_dtype,
    add_out,
    check_out,
    film_files,
    pick,
    summary_table,
    write_results,
)
from jaxslam.consistency.campaign._progress import Progress
from jaxslam.core._numbers import check_count
from jaxslam.core.types import JaxOrNumPy
from jaxslam.datasets import _g2o as g2o
from jaxslam.graphs import Ending, Graph, starts
from jaxslam.graphs._checks import label, variables_in
from jaxslam.graphs._factor import Factor
from jaxslam.graphs._graph import TRUSTED
from jaxslam.graphs._solver.kernels import REGISTRY as KERNELS
from jaxslam.graphs.starts import STARTS
from jaxslam.results._files import Files, csv_text, json_number, json_text, versions

ERRORS = {
    "pose": (graphs.RelativePose(), "e = Z⁻¹ ∘ (Xᵢ⁻¹ ∘ Xⱼ) as (x, y, θ)"),
    "log": (graphs.RelativePoseLog(), "e = log(Z⁻¹ ∘ (Xᵢ⁻¹ ∘ Xⱼ))"),
}
"""The residual of a relative pose by its name: g2o's, and GTSAM's."""

COST = "χ² = Σ eᵀ Ω e, without a factor ½; of relative poses"

ROBUST_STARTS = ("given", "chordal", "robust")
"""Starts tried with a robust kernel: the best one differs from graph to graph."""

NOT_CONVERGED = 1

WORST_ROWS = 10
"""Number of rows with the largest residuals in the summary and the figure."""

MAX_FRAMES = 60
"""Largest number of iterations in a film."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `jaxslam optimize`."""
    parser.add_argument("path", metavar="FILE", help="a graph in the format of g2o or TORO")
    parser.add_argument(
        "--error",
        metavar="NAME",
        default="pose",
        help="the residual of a relative pose, g2o's or GTSAM's, one of: "
        f"{', '.join(ERRORS)} (default: pose)",
    )
    parser.add_argument(
        "--start",
        metavar="NAME",
        help=f"where to start, one of: {', '.join(STARTS)} (default: given; with a kernel each of "
        f"{', '.join(ROBUST_STARTS)}, and the lowest robust cost is kept)",
    )
    parser.add_argument(
        "--kernel",
        metavar="NAME",
        nargs="?",
        const="truncated",
        help="a robust kernel for loop edges and measurements of points, one of: "
        f"{', '.join(KERNELS)} (default: none; without a NAME: truncated)",
    )
    parser.add_argument(
        "--iterations", type=int, default=1000, help="number of steps at most (default: 1000)"
    )
    parser.add_argument(
        "--certificate",
        action="store_true",
        help="also try to prove that no poses have a lower chordal cost",
    )
    add_animate(parser, "of the iterations")
    cache.add_options(parser)
    add_dtype(parser)
    add_out(parser)
    parser.set_defaults(command=optimize_graph)


def optimize_graph(options: argparse.Namespace, command: str) -> int:
    """Optimize a graph, print and write the result; returns the exit status, 1 if not converged."""
    if options.start is not None:
        pick("start", options.start, starts.STARTS)
    kernel = None if options.kernel is None else pick("kernel", options.kernel, graphs.KERNELS)()
    relative, equation = pick("error", options.error, ERRORS)
    if options.animate and isinstance(kernel, graphs.Truncated):
        raise ValueError(
            f"--animate: the kernel {options.kernel} is solved in rounds of many iterations each; "
            "films show the iterations of one"
        )
    check_count("--iterations", options.iterations)
    loaded = g2o.load(options.path)
    check_out(options.out, "optimize")
    known = {**graphs.REGISTRY, "relative_pose": relative}
    factors = {key: known[key] for key in loaded.graph.tables}
    held = graphs.with_gauge(loaded.graph, factors)
    graphs.check_graph(str(options.path), held, factors)
    given = held if kernel is None else graphs.with_loops_apart(held)
    factors = {key: known[key.split("/")[0]] for key in given.tables}
    kernels = {key: kernel for key in given.tables if key not in TRUSTED} if kernel else None
    start_graphs, impossible = _start_graphs(options.start, kernels is not None, given, factors)
    solutions = {}
    with Progress(Path(options.path).name, "starts") as progress:
        progress.say("compiling and solving …")
        with CompileClock() as clock:
            for name, start_graph in start_graphs.items():
                solutions[name] = jax.block_until_ready(
                    graphs.optimize(
                        start_graph,
                        factors,
                        kernel=kernels,
                        iterations=options.iterations,
                    )
                )
            seconds, compiling = clock.seconds, clock.compiling
    tried = {name: float(np.nan_to_num(each.chi2, nan=np.inf)) for name, each in solutions.items()}
    start = min(tried, key=tried.__getitem__)
    start_graph, solution = start_graphs[start], solutions[start]
    found = jax.tree.map(np.asarray, solution.graph)
    squared = _squared(found, factors)
    converged = int(solution.status) == Ending.CONVERGED
    costs = (
        json_number(_sum(_squared(start_graph, factors))),
        json_number(_sum(squared)),
    )
    status = _status(solution, found)
    shown = costs
    if kernels:
        shown = (
            json_number(graphs.chi2(start_graph, factors, kernel=kernels)),
            json_number(solution.chi2),
        )
    cost = "robust cost" if kernels else "χ²"
    subtitles = (
        f"start ({start}): {cost} = {as_text(shown[0])}",
        f"{status.split(':')[0]}: {cost} = {as_text(shown[1])}",
    )
    plain = "" if kernel is None else " without the kernel"
    summary = {
        "file": str(options.path),
        "command": command,
        "cost": f"{COST} {equation}",
        "poses": len(found.poses),
        "points": len(found.points),
        "edges": {key: int(table.valid.sum()) for key, table in found.tables.items()},
        "skipped lines": loaded.skipped,
        "placed along the edges": loaded.placed,
        "gauge": _gauge(loaded.graph, held),
        "start": start,
        "kernel": options.kernel or "none",
        **(_robust(solution, kernels, tried, impossible) if kernels else {}),
        f"chi2 of the file{plain}": costs[0]
        if start_graph is given
        else json_number(_sum(_squared(given, factors))),
        f"chi2 at the start{plain}": costs[0],
        f"chi2{plain}": costs[1],
        "degrees of freedom": graphs.degrees_of_freedom(found, factors),
        "status": status,
        "iterations": int(solution.iterations),
        "gradient / at the start": json_number(
            float(solution.gradient) / (float(solution.gradient_start) or 1.0)
        ),
        "seconds to compile": round(compiling, 3),
        "seconds to run": round(seconds - compiling, 3),
        **(_certificate(found, converged, kernel is None) if options.certificate else {}),
    }
    print(summary_table({"": {key: as_text(value) for key, value in summary.items()}}))
    worst = _worst(found, squared, factors)

    def draw() -> Files:
        from jaxslam.results import plot  # matplotlib is slow to load
        from jaxslam.results.plot._style import pictures

        edges = sum(int(table.valid.sum()) for table in found.tables.values())
        figure = plot.graph_figure(
            start_graph,
            found,
            squared,
            worst=WORST_ROWS,
            subtitles=subtitles,
            title=f"{Path(options.path).name}: {len(found.poses):,} poses, {edges:,} edges",
        )
        return {**pictures("graph", figure, ("png",))}

    files: Files = {
        SUMMARY: json_text(
            summary | {"worst residuals": worst, "versions": versions()},
        ),
        "poses.csv": _csv(("x", "y", "theta"), found.pose_id, found.poses, found.fixed_pose),
        "optimized.g2o": g2o.text_of(
            found._replace(fixed_pose=loaded.graph.fixed_pose, fixed_point=loaded.graph.fixed_point)
        ),
    }
    drawings: Drawings = {"graph": draw}
    if options.animate:
        drawings["film"] = lambda: _film(options, start_graph, factors, kernels, solution)
    if len(found.points):
        files["points.csv"] = _csv(("x", "y"), found.point_id, found.points, found.fixed_point)
    status_of_files = write_results(options.out, files, drawings, (*FILMS, "points.csv"))
    if converged:
        return status_of_files
    print(f"jaxslam: {status}{_advice(int(solution.status), tried)}", file=sys.stderr)
    return NOT_CONVERGED


def _squared(graph: Graph, factors: Mapping[str, Factor]) -> dict[str, np.ndarray]:
    """eᵀ Ω e of each row; one program for the file, the start and the optimum."""
    return {k: np.asarray(s) for k, s in graphs.squared_residuals(graph, factors).items()}


def _sum(squared: Mapping[str, np.ndarray]) -> float:
    return float(sum(s.sum() for s in squared.values()))


def _start_graphs(
    name: str | None, robust: bool, given: Graph, factors: Mapping[str, Factor]
) -> tuple[dict[str, Graph], dict[str, str]]:
    """The graph at each start to try, and the starts that are not possible, with the reason."""
    if name is not None or not robust:
        name = name or "given"
        return {name: starts.STARTS[name](given, factors)}, {}
    start_graphs, impossible = {}, {}
    for each in ROBUST_STARTS:
        try:
            start_graphs[each] = starts.STARTS[each](given, factors)
        except ValueError as error:
            impossible[each] = str(error)
    return start_graphs, impossible


def _robust(
    solution: graphs.Solution,
    kernels: Mapping[str, graphs.Kernel],
    tried: Mapping[str, float],
    impossible: Mapping[str, str],
) -> dict[str, object]:
    """Entries of the summary on a robust kernel: costs, and the number of rows kept."""
    kept, left_out = {}, {}
    for key in kernels:
        valid, weight = np.asarray(solution.graph.tables[key].valid), solution.weights[key]
        kept[key] = int((np.asarray(weight)[valid] > 0.5).sum())
        left_out[key] = int(valid.sum()) - kept[key]
    return {
        "robust cost": json_number(solution.chi2),
        "of weight above 1/2": kept,
        "of weight 1/2 or less": left_out,
        **{f"robust cost from {name}": json_number(cost) for name, cost in tried.items()},
        **{f"robust cost from {name}": f"none: {reason}" for name, reason in impossible.items()},
    }


def _advice(status: int, tried: Collection[str]) -> str:
    """What to try if no minimum was reached; empty for a singular graph, whose status is enough."""
    if status == Ending.SINGULAR:
        return ""
    others = ", ".join(name for name in starts.STARTS if name not in tried)
    more = ", more --iterations" * (status == Ending.EXHAUSTED)
    return (
        f": no minimum was reached; try another start (--start {others}){more}, "
        "or --kernel if loops may be false"
    )


def _gauge(read: Graph, given: Graph) -> str:
    """The gauge in words: the fixed poses and points, or the priors."""
    poses, points = int(given.fixed_pose.sum()), int(given.fixed_point.sum())
    if given is not read:
        held = given.pose_id[given.fixed_pose.argmax()]
        return f"pose {int(held)} is fixed, since the file fixes none"
    fixed = [f"{poses} poses"] * (poses > 0) + [f"{points} points"] * (points > 0)
    return " and ".join(fixed) + " fixed by the file" if fixed else "by priors"


def _status(solution: graphs.Solution, found: Graph) -> str:
    """The status in words, with the variable that is not determined."""
    ending = Ending(int(solution.status))
    if ending != Ending.SINGULAR:
        return str(ending.name.lower())
    return f"singular: the measurements do not determine {label(found, int(solution.singular))}"


def _certificate(found: Graph, converged: bool, plain: bool) -> dict[str, object]:
    """The certificate of the optimum: entries of the summary."""
    if not converged or not plain:
        why = "not for a robust cost" if converged else "no optimum was reached"
        return {"certificate": f"none: {why}"}
    began = time.perf_counter()
    try:
        proof = jax.block_until_ready(graphs.certificate(found))
    except ValueError as error:
        return {"certificate": f"none: {str(error).removeprefix('graphs.certificate: ')}"}
    return {
        "certificate": "the chordal optimum next to it is global"
        if proof.certified
        else "not certified: another optimum of the chordal cost may be lower; try another --start",
        "chordal chi2": json_number(proof.chi2),
        "lower by at most": json_number(proof.gap),
        "distance of the two optima [m]": json_number(proof.position),
        "distance of the two optima [rad]": json_number(proof.heading),
        "seconds of the certificate": round(time.perf_counter() - began, 3),
    }


def _worst(
    graph: Graph, squared: Mapping[str, np.ndarray], factors: Mapping[str, Factor]
) -> list[dict[str, object]]:
    """The rows with the largest eᵀ Ω e for their size, largest first."""
    rows = [
        (float(value) / len(factors[key].errors), key, row)
        for key, values in squared.items()
        for row, value in enumerate(values)
    ]
    found = []
    for _, key, row in sorted(rows, key=lambda entry: -entry[0])[:WORST_ROWS]:
        one = graph.tables[key]._replace(valid=np.arange(len(squared[key])) == row)
        between = variables_in(graph, one, factors[key])[0]
        found.append(
            {
                "table": key,
                "row": row,
                "between": [label(graph, int(variable)) for variable in between],
                "squared residual": json_number(squared[key][row]),
            }
        )
    return found


def _csv(names: tuple[str, ...], ids: JaxOrNumPy, values: JaxOrNumPy, fixed: JaxOrNumPy) -> str:
    """Poses or points as a table, numbers by repr."""
    rows = [
        [str(int(one)), *map(repr, np.asarray(row, float).tolist()), str(int(held))]
        for one, row, held in zip(ids, values, fixed, strict=True)
    ]
    return csv_text(
        ["id", *(f"{n} [{'rad' if n == 'theta' else 'm'}]" for n in names), "fixed"], rows
    )


def _film(
    options: argparse.Namespace,
    start_graph: Graph,
    factors: Mapping[str, Factor],
    kernel: Mapping[str, graphs.Kernel] | None,
    solution: graphs.Solution,
) -> Files:
    """The film of the iterations, by file name.

    Iterate k is the result of the same optimization with a limit of k steps; the limit is an
    argument of the compiled program.
    """
    from jaxslam.results import plot  # matplotlib is slow to load
    from jaxslam.results.plot._graph_figures import graph_scene

    taken = int(solution.iterations)
    shown = np.unique(np.linspace(1, taken, min(taken, MAX_FRAMES)).round().astype(int)).tolist()
    iterates, costs = [start_graph], [float(solution.chi2_start)]
    with Progress(f"{Path(options.path).name}: film", "iterations") as progress:
        for done, steps in enumerate(shown):
            at = graphs.optimize(start_graph, factors, kernel=kernel, iterations=steps)
            iterates.append(jax.tree.map(np.asarray, at.graph))
            costs.append(float(at.chi2))
            progress(done + 1, len(shown))
    note = "" if len(shown) == taken else f"{len(shown)} of {taken} iterations shown"
    scene = graph_scene(
        iterates,
        costs,
        steps=[0, *shown],
        factors=factors,
        title=Path(options.path).name,
        note=note,
    )
    return film_files({"optimize": plot.Film(scene, fps=2.0)}, suffixed=False)


def as_text(value: object) -> str:
    """A value as text; numbers with nine digits, so that optima can be compared."""
    if isinstance(value, dict):
        return ", ".join(f"{key} {count:,}" for key, count in value.items()) or "none"
    if value is None:
        return "not finite"
    return f"{value:.9g}" if isinstance(value, float) else str(value)
