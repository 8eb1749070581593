"""The command line `jaxslam`; only here are arguments parsed and JAX configured."""

import argparse
import os
import platform
import shlex
import sys
from collections.abc import Sequence
from importlib.metadata import version

import jax
from threadpoolctl import threadpool_limits

from jaxslam.catalog import ALL
from jaxslam.cli import cache, devices, fit
from jaxslam.cli.campaign import DEFAULTS, OUT, consistency
from jaxslam.cli.common import INTERRUPTED, as_folders
from jaxslam.cli.compile_clock import CompileClock
from jaxslam.cli.dataset import run_dataset
from jaxslam.cli.laser import options as laser_options
from jaxslam.cli.models import verify_models
from jaxslam.cli.optimize import COST, ERRORS, optimize_graph
from jaxslam.datasets import READERS
from jaxslam.datasets.settings import METHODS
from jaxslam.graphs.kernels import REGISTRY as KERNELS
from jaxslam.graphs.search import METHODS as STEPS
from jaxslam.graphs.starts import STARTS
from jaxslam.results.campaign_files import FORMATS
from jaxslam.results.run_table import FORMATS as RUN_FORMATS
from jaxslam.simulation.scenarios import SCENARIOS

__all__ = ["main"]

USAGE_ERROR = 2
PIPE_CLOSED = 141  # 128 + SIGPIPE, as a shell reports it


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status.

    0 on success, 1 for a wrong model or an optimization that did not converge, 2 on bad input, 130
    if interrupted, 141 if the reader of its output has gone.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    try:
        options = _parser().parse_args(arguments)
    except SystemExit as stop:
        return int(stop.code or 0)
    try:
        as_folders(options)
        if hasattr(options, "devices"):
            devices.prepare(options)
        else:
            jax.config.update("jax_enable_x64", options.dtype == "float64")
        with CompileClock() as clock, cache.from_options(options), threadpool_limits(1, "blas"):
            status = int(options.command(options, shlex.join(["jaxslam", *arguments])))
            if status != INTERRUPTED and jax.process_index() == 0:
                print(clock)
        sys.stdout.flush()  # here, so that a closed pipe is met below
        return status
    except BrokenPipeError:  # the reader, as `head`, has enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return PIPE_CLOSED
    except (ValueError, OSError) as error:
        print(f"jaxslam: {error}", file=sys.stderr)
        return USAGE_ERROR
    except KeyboardInterrupt:
        print("\njaxslam: interrupted; nothing was written", file=sys.stderr)
        return INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    """The parser of the command line; `options.command` is the function to call."""
    parser = argparse.ArgumentParser(
        prog="jaxslam",
        description="2-D landmark SLAM in JAX.",
        epilog="jaxslam COMMAND --help describes the options of a command.",
    )
    parser.add_argument("--version", action="version", version=_versions())
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_consistency(
        commands.add_parser(
            "consistency",
            help="test filters for consistency in a Monte-Carlo campaign",
            description="Run filters over the same simulated worlds and compare their errors with "
            "the covariances they claim. Prints a table and writes JSON, CSV and figures.",
        )
    )
    _add_run(
        commands.add_parser(
            "run",
            help="run filters on a recorded data set",
            description="Run filters on recorded data. Prints a summary and writes trajectory, "
            "map, summary and a figure.",
        )
    )
    fit.add_options(
        commands.add_parser(
            "fit",
            help="fit the noises of your own data to its log",
            description="Find the standard deviations of motion and sensor by maximum likelihood, "
            "with standard errors, from a folder as of `jaxslam run --dataset table`. Prints a "
            "table and writes fit.json and fit.toml, lines for dataset.toml.",
        ),
        OUT,
    )
    _add_optimize(
        commands.add_parser(
            "optimize",
            help="optimize a pose or landmark graph in a file",
            description="Optimize a graph in a file of g2o or TORO. Prints a table and writes the "
            "poses, the optimized graph, a summary and a figure. The cost is "
            f"{COST} {ERRORS['pose'][1]}. The exit status is 1 if the optimization did not "
            "converge, 2 if the file cannot be used.",
        )
    )
    _add_verify(
        commands.add_parser(
            "verify",
            help="verify the Jacobians of every model, or of your own file",
            description="Compare hand-derived Jacobians with forward and reverse autodiff and "
            "with difference quotients. Prints a table, or a report on your file, and writes JSON. "
            "The exit status is 1 if anything fails, 2 if the file cannot be used.",
        )
    )
    return parser


def _add_consistency(parser: argparse.ArgumentParser) -> None:
    """Add the options of `jaxslam consistency`."""
    campaign = parser.add_argument_group(
        "campaign", "kept in the folder of results; --resume reads them there"
    )
    for name, text in {
        "scenario": f"one of: {', '.join(SCENARIOS)}; or FILE.py:NAME, a Scenario or a function "
        "that returns one",
        "filters": f'"all", or some of: {", ".join(ALL)}; and FILE.py:NAME, a Filter or a function '
        "of the scenario that returns one; comma-separated",
        "runs": "number of simulated trajectories",
        "steps": "number of steps of each trajectory; default: the scenario's own",
        "seed": "seed of the random numbers",
    }.items():
        default = DEFAULTS[name]
        kind = str if isinstance(default, str) else int
        text += "" if default is None else f" (default: {default})"
        campaign.add_argument(f"--{name}", type=kind, default=argparse.SUPPRESS, help=text)
    campaign.add_argument(
        "--bound",
        action=argparse.BooleanOptionalAction,
        default=argparse.SUPPRESS,
        help="also compute the Cramér-Rao bound conditional on each true trajectory (default: no)",
    )
    campaign.add_argument(
        "--dtype",
        default=argparse.SUPPRESS,
        choices=["float32", "float64"],
        help="floating-point type of the filters (default: float64)",
    )
    parser.add_argument(
        "--out", metavar="DIR", help=f"folder for results (default: {OUT}; with --resume, its own)"
    )
    parser.add_argument(
        "--figures",
        default="png",
        metavar="FORMATS",
        help=f"formats of the files of figures, of {','.join(FORMATS)}; comma-separated (default: "
        "png; the page always has its own)",
    )
    parser.add_argument(
        "--table",
        default="",
        metavar="FORMATS",
        help=f"also write each run's averages as runs.csv, …; formats of {','.join(RUN_FORMATS)}",
    )
    _add_animate(parser)
    earlier = parser.add_mutually_exclusive_group()
    earlier.add_argument(
        "--resume",
        metavar="DIR",
        help="continue the campaign in a folder of results; with a larger --runs, extend it",
    )
    earlier.add_argument(
        "--overwrite", action="store_true", help="replace the campaign that is in the folder"
    )
    earlier.add_argument(
        "--again",
        action="store_true",
        help="as --overwrite, but only of a finished campaign with the same options",
    )
    parser.add_argument(
        "--block",
        type=int,
        help="number of runs computed together on each device (each core of a CPU is one); memory "
        "grows with it (default: 16 on a CPU, elsewhere by the memory of the device)",
    )
    parser.add_argument(
        "--devices", default="all", help='"all", a number, or a platform: cpu, gpu (default: all)'
    )
    cache.add_options(parser)
    parser.add_argument(
        "--part",
        metavar="I/N",
        help="compute only part I of N of the runs, as 3/16, in a folder that independent jobs "
        "share; --resume then sums up, and computes what is missing",
    )
    others = parser.add_argument_group(
        "several processes", "run the same command in each, with its own --process-id"
    )
    others.add_argument(
        "--coordinator",
        metavar="HOST:PORT",
        help='address on which process 0 listens; "auto" for SLURM, Kubernetes, Open MPI',
    )
    others.add_argument("--processes", type=int, metavar="P", help="number of processes")
    others.add_argument("--process-id", type=int, metavar="I", help="number of this one, from 0")
    others.add_argument(
        "--timeout", type=int, default=60, help="seconds to wait for the others (default: 60)"
    )
    parser.set_defaults(command=consistency)


def _add_run(parser: argparse.ArgumentParser) -> None:
    """Add the options of `jaxslam run`."""
    parser.add_argument(
        "--dataset", required=True, help=f"one of: {', '.join([*READERS, *laser_options.READERS])}"
    )
    parser.add_argument("path", metavar="PATH", help="the file, or the folder, of the data set")
    parser.add_argument(
        "--robot",
        type=int,
        help="number of the robot, where there are several (default: the first)",
    )
    parser.add_argument(
        "--filters",
        default="ekf",
        help=f"some of: {','.join(ALL)}; comma-separated (default: ekf)",
    )
    parser.add_argument(
        "--gate",
        type=float,
        metavar="P",
        help="probability that a correct measurement passes the gate, as 0.999 (default: as the "
        "reader says, mostly none)",
    )
    parser.add_argument(
        "--associate",
        metavar="METHOD",
        help=f"one of: {', '.join(METHODS)} (default: as the reader says, mostly known)",
    )
    parser.add_argument(
        "--check-every",
        type=int,
        metavar="K",
        help="check after every K steps that the covariance is positive definite; 0: never "
        "(default: at 20 steps spread over the log)",
    )
    parser.add_argument(
        "--figures",
        default="png",
        metavar="FORMATS",
        help=f"formats of the figure, of {','.join(FORMATS)}; comma-separated (default: png)",
    )
    _add_animate(parser)
    cache.add_options(parser)
    parser.add_argument(
        "--dtype",
        default="float64",
        choices=["float32", "float64"],
        help="floating-point type of the filter (default: float64)",
    )
    parser.add_argument(
        "--out", metavar="DIR", default=str(OUT), help=f"folder for results (default: {OUT})"
    )
    laser_options.add_options(parser)
    parser.set_defaults(command=run_dataset)


def _add_animate(parser: argparse.ArgumentParser) -> None:
    """Add the option of films."""
    parser.add_argument(
        "--animate",
        action="store_true",
        help="also write a film of each filter (consistency: of run 0): film.html to step and "
        "play, and film.mp4, or film.gif where ffmpeg is missing",
    )


def _add_optimize(parser: argparse.ArgumentParser) -> None:
    """Add the options of `jaxslam optimize`."""
    parser.add_argument("path", metavar="FILE", help="a graph in the format of g2o or TORO")
    for name, default, known, text in (
        ("start", "given", STARTS, "where to start"),
        ("method", "levenberg_marquardt", STEPS, "the steps"),
        ("kernel", None, KERNELS, "a robust kernel for loop edges and measurements of points"),
        ("error", "pose", ERRORS, "the residual of a relative pose, g2o's or GTSAM's"),
    ):
        parser.add_argument(
            f"--{name}",
            metavar="NAME",
            default=default,
            help=f"{text}, one of: {', '.join(known)} (default: {default or 'none'})",
        )
    parser.add_argument(
        "--iterations", type=int, default=1000, help="number of steps at most (default: 1000)"
    )
    parser.add_argument(
        "--certificate",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="also prove, where it can be, that no poses have a lower chordal cost (default: yes)",
    )
    cache.add_options(parser)
    parser.add_argument(
        "--dtype",
        default="float64",
        choices=["float32", "float64"],
        help="floating-point type (default: float64)",
    )
    parser.add_argument(
        "--out", metavar="DIR", default=str(OUT), help=f"folder for results (default: {OUT})"
    )
    parser.set_defaults(command=optimize_graph)


def _add_verify(parser: argparse.ArgumentParser) -> None:
    """Add the options of `jaxslam verify`."""
    parser.add_argument(
        "target",
        metavar="FILE.py[:NAME]",
        nargs="?",
        help="a file that defines a Motion, a Sensor, a factory of one, or a function f and its "
        "f_jacobian; NAME: only that one (default: every model of jaxslam)",
    )
    parser.add_argument(
        "--states", type=int, default=24, help="number of random states (default: 24)"
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of the random states (default: 0)"
    )
    parser.add_argument(
        "--out", metavar="DIR", default=str(OUT), help=f"folder for results (default: {OUT})"
    )
    cache.add_options(parser)
    parser.set_defaults(command=verify_models, dtype="float64")


def _versions() -> str:
    """The versions of jaxslam, JAX and Python."""
    return (
        f"jaxslam {version('jaxslam')} (jax {jax.__version__}, Python {platform.python_version()})"
    )
