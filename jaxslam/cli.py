"""The command `jaxslam`: the only place that parses arguments or configures JAX."""

import argparse
import os
import shlex
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam import motion, page, plot, report, se2, sensors, userfile, verify
from jaxslam.consistency import align_map
from jaxslam.datasets import READERS
from jaxslam.family import FILTERS
from jaxslam.filters.ekf_slam import ekf_slam
from jaxslam.linalg import is_positive_definite
from jaxslam.monte_carlo import Campaign, monte_carlo
from jaxslam.protocols import Candidate, Filter
from jaxslam.run import run
from jaxslam.scenarios import SCENARIOS
from jaxslam.simulate import Scenario, simulate
from jaxslam.types import Status

_T = TypeVar("_T")

USAGE_ERROR = 2
FAILED = 1
INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 on success, 1 for a wrong model, 2 on bad input, 130 if interrupted."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    try:
        options = _parser().parse_args(arguments)
    except SystemExit as stop:
        return int(stop.code or 0)
    jax.config.update("jax_enable_x64", options.dtype == "float64")
    try:
        return int(options.command(options, shlex.join(["jaxslam", *arguments])))
    except (ValueError, OSError) as error:
        print(f"jaxslam: {error}", file=sys.stderr)
        return USAGE_ERROR
    except KeyboardInterrupt:
        print("\njaxslam: interrupted; nothing was written", file=sys.stderr)
        return INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="jaxslam", description="2-D landmark SLAM in JAX.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    judge = commands.add_parser(
        "consistency",
        help="is a filter honest? a Monte-Carlo campaign",
        description="Run filters over the same simulated worlds and compare their errors with the "
        "covariances they claim. Prints a table and writes JSON, CSV and figures.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    judge.add_argument("--scenario", default="circle", help=f"one of: {', '.join(SCENARIOS)}")
    judge.add_argument(
        "--filters", default="ekf", help=f'"all", or some of: {",".join(FILTERS)}; comma-separated'
    )
    judge.add_argument("--runs", type=int, default=100, help="simulated trajectories")
    judge.add_argument("--steps", type=int, help="steps of each; default: the scenario's own")
    judge.add_argument("--block", type=int, default=32, help="runs computed together; sets memory")
    judge.add_argument("--seed", type=int, default=0, help="of every draw")
    judge.add_argument(
        "--bound",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="also the posterior Cramér-Rao bound",
    )
    judge.set_defaults(command=_consistency)

    drive = commands.add_parser(
        "run",
        help="EKF-SLAM on a data set",
        description="Run EKF-SLAM on recorded data; writes trajectory, map, summary and a picture.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    drive.add_argument("--dataset", required=True, help=f"one of: {', '.join(READERS)}")
    drive.add_argument("path", metavar="PATH", help="the file, or the folder, of the data set")
    drive.add_argument("--robot", type=int, help="which robot, where a data set has several")
    drive.set_defaults(command=_run_dataset)

    check = commands.add_parser(
        "verify",
        help="is a Jacobian right? of every model, or of your own file",
        description="Hold Jacobians by forward and reverse autodiff, by hand and by differences "
        "against each other. Without a file: every motion model and sensor of jaxslam. Exit status "
        "1 if anything fails, 2 if the file cannot be used. Prints a table or report, writes JSON.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    check.add_argument(
        "target",
        metavar="FILE.py[:NAME]",
        nargs="?",
        help="a file that defines a Motion, a Sensor, or a function f and its f_jacobian",
    )
    check.add_argument("--states", type=int, default=24, help="random states beside the hard ones")
    check.add_argument("--seed", type=int, default=0, help="of the random states")
    check.add_argument("--out", type=Path, default=Path("out"), help="folder for results")
    check.set_defaults(command=_verify, dtype="float64")

    for command in (judge, drive):
        command.add_argument("--dtype", default="float64", choices=["float32", "float64"])
        command.add_argument("--out", type=Path, default=Path("out"), help="folder for results")
    return parser


def _consistency(options: argparse.Namespace, command: str) -> int:
    scenario = _scenario(options.scenario, options.steps)
    names = list(FILTERS) if options.filters == "all" else options.filters.split(",")
    filters = {name: _filter(name, scenario) for name in names}
    if not 0 <= options.seed < 2**32:
        raise ValueError(f"expected a seed between 0 and 2³²-1, got {options.seed}")
    report.check_writable(options.out)
    key = jax.random.key(options.seed)
    with _Progress(f"{scenario.name}, {len(filters)} filter(s)") as progress:
        campaign = monte_carlo(
            scenario,
            filters,
            options.runs,
            key,
            block=options.block,
            bound=options.bound,
            progress=progress,
        )
    print(report.table(campaign))
    written = report.write_files(options.out, _campaign_files(campaign, scenario, options, command))
    print(f"\n{campaign.seconds:.1f} s; wrote " + ", ".join(str(path) for path in written))
    return 0


def _campaign_files(
    campaign: Campaign, scenario: Scenario, options: argparse.Namespace, command: str
) -> dict[str, str | Callable[[Path], object]]:
    """The campaign, and pictures of its first run under its first filter."""
    name = next(iter(campaign.filters))
    key_world, key_filter = jax.random.split(jax.random.fold_in(jax.random.key(options.seed), 0))
    truth, log = jax.jit(partial(simulate, scenario))(key_world)
    candidate = FILTERS[name](scenario)
    filter = candidate if isinstance(candidate, Filter) else candidate(truth)
    assert isinstance(filter, Filter)
    trace = run(filter, log, scenario.pose, scenario.pose_cov, key_filter)
    title = f"{scenario.name}, {name}, run 0 of seed {options.seed}"
    figures = {
        "nees": ("NEES against time, with its 95 % band", plot.nees_figure(campaign)),
        "bound": ("RMSE against the Cramér-Rao bound", plot.bound_figure(campaign)),
        "coverage": ("Coverage of the ellipsoids", plot.coverage_figure(campaign)),
        "whiteness": ("Autocorrelation of innovations", plot.whiteness_figure(campaign)),
        "gained": ("Information wrongly gained of a turn", plot.gained_figure(campaign)),
        "errors": (f"Errors: {title}", plot.errors_figure(trace.estimate, truth, title=title)),
        "map": (f"Map: {title}", plot.map_figure(trace.estimate, truth=truth, title=title)),
    }
    return {
        "report.html": page.page(
            campaign,
            report.ROWS,
            command,
            options.seed,
            report.versions(),
            dict(figures.values()),
        ),
        "consistency.json": report.as_json(campaign, command, options.seed),
        "consistency.csv": report.as_csv(campaign),
    } | {f"{name}.png": figure.savefig for name, (_, figure) in figures.items()}


def _run_dataset(options: argparse.Namespace, command: str) -> int:
    data = _pick("dataset", options.dataset, READERS)(options.path, options.robot)
    report.check_writable(options.out)
    ekf = ekf_slam(data.motion, data.sensor, data.capacity, **data.filter_options)
    with _Progress(f"{data.name}, {data.steps:,} steps") as progress:
        progress.say("running …")
        began = time.perf_counter()
        # Value checks happen on the host here; the log then enters the run in the chosen dtype.
        trace = run(
            ekf,
            jax.tree.map(jnp.asarray, data.log),
            data.pose,
            data.pose_cov,
            jax.random.key(0),
            probe=lambda joint: is_positive_definite(joint.cov),
        )
        jax.block_until_ready(trace)
    seconds = time.perf_counter() - began
    last = jax.tree.map(lambda leaf: leaf[-1], trace.estimate)
    nis = jnp.where(trace.info.status == Status.FUSED, trace.info.nis, 0.0).sum()
    summary: dict[str, Any] = {
        "dataset": data.name,
        "source": data.source,
        "command": command,
        "dtype": str(last.pose.dtype),
        "steps": data.steps,
        "measurements": data.measurements,
        "landmarks": int(last.alive.sum()),
        "status": {
            s.name.lower(): int(trace.info.tally(s).sum()) for s in Status if s != Status.EMPTY
        },
        "dropped by the reader": data.dropped,
        "corrections to the data": list(data.corrections),
        "NIS / dof": float(nis / jnp.maximum(trace.info.dof.sum(), 1)),
        "log-likelihood": float(trace.info.log_likelihood.sum()),
        # P0 = 0 is singular until noise has entered; from then on P must stay positive definite.
        "positive definite from step": 2 + int(np.max(np.flatnonzero(~trace.probe), initial=-1)),
        "final pose": [float(value) for value in last.pose],
        "seconds": round(seconds, 2),
    }
    surveyed = None
    if data.landmarks is not None and summary["landmarks"]:
        frame, summary["map RMSE after alignment [m]"] = align_map(last, data.landmarks)
        into_map = jax.vmap(se2.to_frame, (None, 0))
        surveyed = np.asarray(into_map(jnp.asarray(frame), jnp.asarray(data.landmarks)))
    figure = plot.map_figure(trace.estimate, true_points=surveyed, title=data.name)
    files: dict[str, str | Callable[[Path], object]] = {
        "trajectory.csv": report.trajectory_csv(data.time, trace.estimate),
        "map.csv": report.map_csv(last, data.tags),
        "summary.json": report.json_text(summary | {"versions": report.versions()}),
        "map.png": figure.savefig,
    }
    for name, value in summary.items():
        print(f"{name:30} {_shown(value)}")
    written = report.write_files(options.out, files)
    print("\nwrote " + ", ".join(str(path) for path in written))
    return 0


def _verify(options: argparse.Namespace, command: str) -> int:
    began = time.perf_counter()
    report.check_writable(options.out)
    ask = partial(verify.verify_jacobians, count=options.states, seed=options.seed)
    if options.target is None:
        reports = _verify_all(ask)
        print(verify.table(reports))
    else:
        reports = userfile.verify_file(options.target, ask)
    details = reports if options.target else [r for r in reports if not r.passed]
    print("\n".join(["", *(str(r) for r in details)]) if details else "")
    passed = all(r.passed for r in reports)
    content = {
        "command": command,
        "passed": passed,
        "reports": [r.as_dict() for r in reports],
        "seconds": round(time.perf_counter() - began, 2),
        "versions": report.versions(),
    }
    written = report.write_files(options.out, {"verify.json": report.json_text(content)})
    print(f"{content['seconds']:.1f} s; wrote {written[0]}")
    return 0 if passed else FAILED


def _verify_one(ask: Callable[..., verify.Report], factory: Callable[..., Any]) -> verify.Report:
    return ask(verify.build(factory))


def _verify_all(ask: Callable[..., verify.Report]) -> list[verify.Report]:
    models = motion.REGISTRY | sensors.REGISTRY
    reports = []
    with (
        _Progress(f"{len(models)} models", "models") as progress,
        ThreadPoolExecutor(os.cpu_count()) as pool,  # compilation takes most of the time
    ):
        tasks = [pool.submit(_verify_one, ask, factory) for factory in models.values()]
        try:
            for task in tasks:
                reports.append(task.result())
                progress(len(reports), len(models))
        except BaseException:  # an interrupt: what has not begun need not
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return reports


def _shown(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {count:,}" for key, count in value.items()) or "-"
    if isinstance(value, list):
        return "; ".join(_shown(part) for part in value) or "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _scenario(name: str, steps: int | None) -> Scenario:
    make = _pick("scenario", name, SCENARIOS)
    return make() if steps is None else make(steps)


def _filter(name: str, scenario: Scenario) -> Candidate:
    """A filter of the family for a scenario, or ValueError by name if it cannot run there."""
    make = _pick("filter", name, FILTERS)
    try:
        return make(scenario, watch=True)
    except ValueError as error:
        raise ValueError(
            f"filter {name!r} cannot run scenario {scenario.name!r}: {error}"
        ) from error


def _pick(kind: str, name: str, known: Mapping[str, _T]) -> _T:
    if name not in known:
        raise ValueError(f"unknown {kind} {name!r}; known: {', '.join(known)}")
    return known[name]


class _Progress:
    """A bar on a terminal; silent where the output is not one."""

    def __init__(self, what: str, unit: str = "runs") -> None:
        self._what, self._unit = what, unit
        self._began = time.perf_counter()
        self._shown = sys.stderr.isatty()

    def __enter__(self) -> "_Progress":
        self.say("compiling …")
        return self

    def say(self, what: str) -> None:
        self._draw(f"{self._what}: {what}")

    def __call__(self, done: int, total: int) -> None:
        filled = round(30 * done / total)
        spent = time.perf_counter() - self._began
        bar = "█" * filled + "░" * (30 - filled)
        self._draw(f"{self._what}: {bar} {done:,}/{total:,} {self._unit}, {spent:.0f} s")

    def __exit__(self, *_: object) -> None:
        self._draw("")

    def _draw(self, line: str) -> None:
        if self._shown:
            print(f"\r\x1b[K{line}", end="", file=sys.stderr, flush=True)
