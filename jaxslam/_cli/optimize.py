"""The command `jaxslam optimize`: the optimum of a graph in a file."""

import argparse
import dataclasses
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

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
from jaxslam.core._table import csv_text
from jaxslam.core.types import JaxOrNumPy
from jaxslam.core.validation import InvalidField, at_least, refusals_of, require
from jaxslam.datasets import _g2o as g2o
from jaxslam.graphs import Ending, Graph
from jaxslam.graphs._checks import label, variables_in
from jaxslam.graphs._factor import Factor
from jaxslam.graphs._graph import TRUSTED
from jaxslam.graphs._solver.kernels import REGISTRY as KERNELS
from jaxslam.graphs.starts import STARTS
from jaxslam.results._files import Files, Json, json_number, json_text, versions

ERRORS = {
    "pose": (graphs.RelativePose(), "e = Z⁻¹ ∘ (Xᵢ⁻¹ ∘ Xⱼ) as (x, y, θ)"),
    "log": (graphs.RelativePoseLog(), "e = log(Z⁻¹ ∘ (Xᵢ⁻¹ ∘ Xⱼ))"),
}
"""The residual of a relative pose by its name: g2o's, and GTSAM's."""

COST = "χ² = Σ eᵀ Ω e, without a factor ½; of relative poses"

ROBUST_STARTS = ("given", "chordal", "robust")
"""Starts tried with a robust kernel: the best one differs from graph to graph."""

NOT_CONVERGED = 1
"""Exit status if the optimization did not converge."""

WORST_ROWS = 10
"""Number of rows with the largest residuals in the summary and the figure."""

MAX_FRAMES = 60
"""Largest number of iterations in a film: at two a second it plays for half a minute."""


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


@dataclasses.dataclass(frozen=True)
class OptimizePlan:
    """Plan of `jaxslam optimize`; the fields are the options of the same name."""

    path: str
    error: str = "pose"
    start: str | None = None
    kernel: str | None = None
    iterations: int = 1000
    certificate: bool = False
    animate: bool = False

    def __post_init__(self) -> None:
        """Raise ValueError on an unknown name or a film of a kernel that is solved in rounds."""
        if self.start is not None:
            pick("start", self.start, STARTS)
        kernel = self.robust_kernel
        pick("error", self.error, ERRORS)
        if self.animate and isinstance(kernel, graphs.Truncated):
            raise ValueError(
                f"--animate: the kernel {self.kernel} is solved in rounds of many iterations each; "
                "films show the iterations of one"
            )
        require("--iterations", self.iterations, at_least(1))

    @classmethod
    def from_options(cls, options: argparse.Namespace) -> "OptimizePlan":
        """The plan of the options of the command."""
        return cls(
            **{field.name: getattr(options, field.name) for field in dataclasses.fields(cls)}
        )

    @property
    def robust_kernel(self) -> graphs.Kernel | None:
        """The robust kernel of that name; None without one."""
        return None if self.kernel is None else pick("kernel", self.kernel, graphs.KERNELS)()


class Problem(NamedTuple):
    """The graph of a file as it is solved."""

    loaded: g2o.Loaded
    """the file as it was read"""
    graph: Graph
    """the graph with a gauge; with a kernel, loops are a separate table"""
    factors: dict[str, Factor]
    """factor of each table"""
    kernels: dict[str, graphs.Kernel] | None
    """kernel of each table that may hold outliers; None without a kernel"""


class Optimum(NamedTuple):
    """The result of `solve`: the solution of lowest cost, and the costs of all starts."""

    problem: Problem
    start: str
    """name of the start that led to the lowest cost"""
    start_graph: Graph
    solution: graphs.Solution
    graph: Graph
    """the graph of the solution, as NumPy arrays"""
    cost_by_start: dict[str, float]
    """final cost by the name of the start; infinity if it is not finite"""
    impossible: dict[str, str]
    """reason why there is no such start, by name"""
    squared: dict[str, np.ndarray]
    """eᵀ Ω e of each row at the solution, by table"""
    chi2_of_file: float
    chi2_at_start: float
    cost_at_start: float
    """the minimized cost: χ², or with kernels the robust cost"""
    certificate: Json
    """entries of the summary on global optimality"""
    seconds: float
    """wall time of the solver, with compilation [s]"""
    compiling: float
    """wall time of compilation [s]"""

    @property
    def converged(self) -> bool:
        """Whether a minimum was reached."""
        return int(self.solution.status) == Ending.CONVERGED

    @property
    def chi2(self) -> float:
        """χ² of the solution, without a kernel."""
        return _sum(self.squared)

    @property
    def cost(self) -> float:
        """The minimized cost at the solution: χ², or with kernels the robust cost."""
        return float(self.solution.chi2) if self.problem.kernels else self.chi2

    @property
    def status(self) -> str:
        """The status in words, with the variable that is not determined."""
        ending = Ending(int(self.solution.status))
        if ending != Ending.SINGULAR:
            return str(ending.name.lower())
        variable = label(self.graph, int(self.solution.singular))
        return f"singular: the measurements do not determine {variable}"


def optimize_graph(options: argparse.Namespace, command: str) -> int:
    """Optimize a graph, print and write the result; returns the exit status, 1 if not converged."""
    plan = OptimizePlan.from_options(options)
    problem = read_problem(plan)
    check_out(options.out, "optimize")
    optimum = solve(plan, problem)
    summary = summarize(plan, optimum, command)
    print(summary_table({"": {key: as_text(value) for key, value in summary.items()}}))
    status = write_optimum(options.out, plan, optimum, summary)
    if optimum.converged:
        return status
    advice, ending = "", int(optimum.solution.status)
    if ending != Ending.SINGULAR:  # whose status is enough
        untried = ", ".join(name for name in STARTS if name not in optimum.cost_by_start)
        longer = ", more --iterations" * (ending == Ending.EXHAUSTED)
        advice = (
            f": no minimum was reached; try another start (--start {untried}){longer}, "
            "or --kernel if loops may be false"
        )
    print(f"jaxslam: {optimum.status}{advice}", file=sys.stderr)
    return NOT_CONVERGED


def read_problem(plan: OptimizePlan) -> Problem:
    """Read the graph of a file, fix a pose if nothing else does, and choose factors and kernels."""
    loaded = g2o.load(plan.path)
    factor_of = {**graphs.REGISTRY, "relative_pose": ERRORS[plan.error][0]}
    factors = {key: factor_of[key] for key in loaded.graph.tables}
    graph = graphs.with_gauge(loaded.graph, factors)
    with refusals_of(str(plan.path)):
        graphs.check_graph(graph, factors)
    kernel = plan.robust_kernel
    if kernel is None:
        return Problem(loaded, graph, factors, None)
    graph = graphs.with_loops_apart(graph)
    # "relative_pose/loops" has the factor of "relative_pose".
    factors = {key: factor_of[key.split("/")[0]] for key in graph.tables}
    kernels = {key: kernel for key in graph.tables if key not in TRUSTED}
    return Problem(loaded, graph, factors, kernels)


def solve(plan: OptimizePlan, problem: Problem) -> Optimum:
    """Optimize from each start of the plan; the solution of lowest cost is kept."""
    graph, factors, kernels = problem.graph, problem.factors, problem.kernels
    start_graphs, impossible = _start_graphs(plan.start, kernels is not None, graph, factors)
    solutions = {}
    with Progress(Path(plan.path).name, "starts") as progress:
        progress.say("compiling and solving …")
        with CompileClock() as clock:
            for name, start_graph in start_graphs.items():
                solutions[name] = jax.block_until_ready(
                    graphs.optimize(
                        start_graph, factors, kernel=kernels, iterations=plan.iterations
                    )
                )
            seconds, compiling = clock.seconds, clock.compiling
    cost_by_start = {
        name: float(np.nan_to_num(solution.chi2, nan=np.inf))
        for name, solution in solutions.items()
    }
    start = min(cost_by_start, key=cost_by_start.__getitem__)
    start_graph, solution = start_graphs[start], solutions[start]
    final = jax.tree.map(np.asarray, solution.graph)
    chi2_at_start = _sum(_squared_residuals(start_graph, factors))
    certificate: Json = {}
    if plan.certificate:
        converged = int(solution.status) == Ending.CONVERGED
        certificate = _certificate(final, converged, plan.kernel is None)
    return Optimum(
        problem=problem,
        start=start,
        start_graph=start_graph,
        solution=solution,
        graph=final,
        cost_by_start=cost_by_start,
        impossible=impossible,
        squared=_squared_residuals(final, factors),
        chi2_of_file=chi2_at_start
        if start_graph is graph
        else _sum(_squared_residuals(graph, factors)),
        chi2_at_start=chi2_at_start,
        cost_at_start=float(graphs.chi2(start_graph, factors, kernel=kernels))
        if kernels
        else chi2_at_start,
        certificate=certificate,
        seconds=seconds,
        compiling=compiling,
    )


def _squared_residuals(graph: Graph, factors: Mapping[str, Factor]) -> dict[str, np.ndarray]:
    """eᵀ Ω e of each row; one program for the file, the start and the optimum."""
    return {k: np.asarray(s) for k, s in graphs.squared_residuals(graph, factors).items()}


def _sum(squared: Mapping[str, np.ndarray]) -> float:
    return float(sum(s.sum() for s in squared.values()))


def _start_graphs(
    start: str | None, robust: bool, graph: Graph, factors: Mapping[str, Factor]
) -> tuple[dict[str, Graph], dict[str, str]]:
    """The graph at each start to try, and the starts that are not possible, with the reason."""
    if start is not None or not robust:
        start = start or "given"
        return {start: STARTS[start](graph, factors)}, {}
    start_graphs, impossible = {}, {}
    for start in ROBUST_STARTS:
        try:
            start_graphs[start] = STARTS[start](graph, factors)
        except ValueError as error:
            impossible[start] = str(error)
    return start_graphs, impossible


def _certificate(graph: Graph, converged: bool, plain: bool) -> Json:
    """The certificate of an optimum: entries of the summary.

    plain: whether the cost is χ², without a kernel.
    """
    if not converged or not plain:
        reason = "not for a robust cost" if converged else "no optimum was reached"
        return {"certificate": f"none: {reason}"}
    began = time.perf_counter()
    try:
        proof = jax.block_until_ready(graphs.certificate(graph))
    except InvalidField as error:
        return {"certificate": f"none: {error.reason}"}
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


def summarize(plan: OptimizePlan, optimum: Optimum, command: str) -> Json:
    """The entries of the summary, in the order in which they are printed."""
    problem, graph, solution = optimum.problem, optimum.graph, optimum.solution
    plain = "" if plan.kernel is None else " without the kernel"
    # `graphs.with_gauge` fixes a pose only in a graph without a gauge.
    fixed_pose = problem.graph.fixed_pose
    if not np.array_equal(fixed_pose, problem.loaded.graph.fixed_pose):
        gauge = (
            f"pose {int(problem.graph.pose_id[fixed_pose.argmax()])} is fixed, "
            "since the file fixes none"
        )
    else:
        poses, points = int(fixed_pose.sum()), int(problem.graph.fixed_point.sum())
        fixed = [f"{poses} poses"] * (poses > 0) + [f"{points} points"] * (points > 0)
        gauge = " and ".join(fixed) + " fixed by the file" if fixed else "by priors"
    return {
        "file": str(plan.path),
        "command": command,
        "cost": f"{COST} {ERRORS[plan.error][1]}",
        "poses": len(graph.poses),
        "points": len(graph.points),
        "edges": {key: int(table.valid.sum()) for key, table in graph.tables.items()},
        "skipped lines": problem.loaded.skipped,
        "placed along the edges": problem.loaded.placed,
        **({"notes": "; ".join(notes)} if (notes := problem.loaded.notes) else {}),
        "gauge": gauge,
        "start": optimum.start,
        "kernel": plan.kernel or "none",
        **(_robust_entries(optimum, problem.kernels) if problem.kernels else {}),
        f"chi2 of the file{plain}": json_number(optimum.chi2_of_file),
        f"chi2 at the start{plain}": json_number(optimum.chi2_at_start),
        f"chi2{plain}": json_number(optimum.chi2),
        "degrees of freedom": graphs.degrees_of_freedom(graph, problem.factors),
        "status": optimum.status,
        "iterations": int(solution.iterations),
        "gradient / at the start": json_number(
            float(solution.gradient) / (float(solution.gradient_start) or 1.0)
        ),
        "seconds to compile": round(optimum.compiling, 3),
        "seconds to run": round(optimum.seconds - optimum.compiling, 3),
        **optimum.certificate,
    }


def _robust_entries(optimum: Optimum, kernels: Mapping[str, graphs.Kernel]) -> Json:
    """Entries of the summary on a robust kernel: costs, and the number of rows it keeps."""
    solution = optimum.solution
    kept, left_out = {}, {}
    for key in kernels:
        valid, weight = np.asarray(solution.graph.tables[key].valid), solution.weights[key]
        kept[key] = int((np.asarray(weight)[valid] > 0.5).sum())
        left_out[key] = int(valid.sum()) - kept[key]
    return {
        "robust cost": json_number(solution.chi2),
        "of weight above 1/2": kept,
        "of weight 1/2 or less": left_out,
        **{f"robust cost from {n}": json_number(c) for n, c in optimum.cost_by_start.items()},
        **{f"robust cost from {n}": f"none: {why}" for n, why in optimum.impossible.items()},
    }


def worst_rows(
    graph: Graph, squared: Mapping[str, np.ndarray], factors: Mapping[str, Factor]
) -> list[Json]:
    """The rows with the largest eᵀ Ω e for their size, largest first."""
    rows = [
        (float(value) / len(factors[key].errors), key, row)
        for key, values in squared.items()
        for row, value in enumerate(values)
    ]
    worst: list[Json] = []
    for _, key, row in sorted(rows, key=lambda entry: -entry[0])[:WORST_ROWS]:
        only_row = graph.tables[key]._replace(valid=np.arange(len(squared[key])) == row)
        between = variables_in(graph, only_row, factors[key])[0]
        worst.append(
            {
                "table": key,
                "row": row,
                "between": [label(graph, int(variable)) for variable in between],
                "squared residual": json_number(squared[key][row]),
            }
        )
    return worst


def write_optimum(folder: Path, plan: OptimizePlan, optimum: Optimum, summary: Json) -> int:
    """Write summary, poses, points, graph, figure and film; returns the exit status."""
    graph, file_graph = optimum.graph, optimum.problem.loaded.graph
    worst = worst_rows(graph, optimum.squared, optimum.problem.factors)
    # The pose that only this command fixed is free in the file that is written, as it was read.
    as_read = graph._replace(fixed_pose=file_graph.fixed_pose, fixed_point=file_graph.fixed_point)
    files: Files = {
        SUMMARY: json_text(summary | {"worst residuals": worst, "versions": versions()}),
        "poses.csv": _csv(("x", "y", "theta"), graph.pose_id, graph.poses, graph.fixed_pose),
        "optimized.g2o": g2o.text_of(as_read),
    }
    if len(graph.points):
        files["points.csv"] = _csv(("x", "y"), graph.point_id, graph.points, graph.fixed_point)
    drawings: Drawings = {"graph": lambda: _figure(plan, optimum)}
    if plan.animate:
        drawings["film"] = lambda: _film(plan, optimum)
    return write_results(folder, files, drawings, (*FILMS, "points.csv"))


def _csv(names: tuple[str, ...], ids: JaxOrNumPy, values: JaxOrNumPy, fixed: JaxOrNumPy) -> str:
    """Poses or points as a table, numbers by repr."""
    rows = [
        [str(int(name)), *map(repr, np.asarray(row, float).tolist()), str(int(is_fixed))]
        for name, row, is_fixed in zip(ids, values, fixed, strict=True)
    ]
    return csv_text(
        ["id", *(f"{n} [{'rad' if n == 'theta' else 'm'}]" for n in names), "fixed"], rows
    )


def _figure(plan: OptimizePlan, optimum: Optimum) -> Files:
    """The figure of the graph at its start and its optimum, by file name."""
    from jaxslam.results import plot  # matplotlib is slow to load
    from jaxslam.results.plot._style import pictures

    graph = optimum.graph
    edges = sum(int(table.valid.sum()) for table in graph.tables.values())
    cost = "robust cost" if optimum.problem.kernels else "χ²"
    status = optimum.status.split(":")[0]
    figure = plot.graph_figure(
        optimum.start_graph,
        graph,
        optimum.squared,
        worst=WORST_ROWS,
        subtitles=(
            f"start ({optimum.start}): {cost} = {as_text(json_number(optimum.cost_at_start))}",
            f"{status}: {cost} = {as_text(json_number(optimum.cost))}",
        ),
        title=f"{Path(plan.path).name}: {len(graph.poses):,} poses, {edges:,} edges",
    )
    return {**pictures("graph", figure, ("png",))}


def _film(plan: OptimizePlan, optimum: Optimum) -> Files:
    """The film of the iterations, by file name.

    Iterate k is the result of the same optimization with a limit of k steps; the limit is an
    argument of the compiled program.
    """
    from jaxslam.results.plot._graph_figures import graph_film  # matplotlib is slow to load

    factors, kernels = optimum.problem.factors, optimum.problem.kernels
    total = int(optimum.solution.iterations)
    steps = np.unique(np.linspace(1, total, min(total, MAX_FRAMES)).round().astype(int)).tolist()
    iterates, costs = [optimum.start_graph], [float(optimum.solution.chi2_start)]
    with Progress(f"{Path(plan.path).name}: film", "iterations") as progress:
        for frame, limit in enumerate(steps):
            iterate = graphs.optimize(
                optimum.start_graph, factors, kernel=kernels, iterations=limit
            )
            iterates.append(jax.tree.map(np.asarray, iterate.graph))
            costs.append(float(iterate.chi2))
            progress(frame + 1, len(steps))
    film = graph_film(
        iterates,
        costs,
        steps=[0, *steps],
        factors=factors,
        title=Path(plan.path).name,
        note="" if len(steps) == total else f"{len(steps)} of {total} iterations shown",
    )
    return film_files({"optimize": film}, suffixed=False)


def as_text(value: object) -> str:
    """A value as text; numbers with nine digits, so that optima can be compared."""
    if isinstance(value, dict):
        return ", ".join(f"{key} {count:,}" for key, count in value.items()) or "none"
    if value is None:
        return "not finite"
    return f"{value:.9g}" if isinstance(value, float) else str(value)
