"""The command line `jaxslam`; only here are arguments parsed and JAX configured."""

import argparse
import platform
import shlex
import sys
from collections.abc import Sequence
from importlib.metadata import version

import jax
from threadpoolctl import threadpool_limits

from jaxslam.catalog import ALL
from jaxslam.cli import cache, devices
from jaxslam.cli.campaign import DEFAULTS, OUT, consistency
from jaxslam.cli.common import INTERRUPTED, as_folders
from jaxslam.cli.compile_clock import CompileClock
from jaxslam.cli.dataset import run_dataset
from jaxslam.cli.models import verify_models
from jaxslam.datasets import READERS
from jaxslam.results.campaign_files import FORMATS
from jaxslam.simulation.scenarios import SCENARIOS

__all__ = ["main"]

USAGE_ERROR = 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status.

    0 on success, 1 for a wrong model, 2 on bad input, 130 if interrupted.
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
        return status
    except (ValueError, OSError) as error:
        print(f"jaxslam: {error}", file=sys.stderr)
        return USAGE_ERROR
    except KeyboardInterrupt:
        print("\njaxslam: interrupted; nothing was written", file=sys.stderr)
        return INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    """The parser of the command line; `options.command` is the function to call."""
    parser = argparse.ArgumentParser(prog="jaxslam", description="2-D landmark SLAM in JAX.")
    parser.add_argument("--version", action="version", version=_versions())
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_consistency(
        commands.add_parser(
            "consistency",
            help="is a filter consistent? a Monte-Carlo campaign",
            description="Run filters over the same simulated worlds and compare their errors with "
            "the covariances they claim. Prints a table and writes JSON, CSV and figures.",
        )
    )
    _add_run(
        commands.add_parser(
            "run",
            help="EKF-SLAM on a data set",
            description="Run EKF-SLAM on recorded data; writes trajectory, map, summary and a "
            "picture.",
            formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        )
    )
    _add_verify(
        commands.add_parser(
            "verify",
            help="is a Jacobian right? of every model, or of your own file",
            description="Compare Jacobians by forward and reverse autodiff, by hand and by "
            "differences. Without a file: every motion model and sensor of jaxslam. Exit status 1 "
            "if anything fails, 2 if the file cannot be used. Prints a table or report, writes "
            "JSON.",
            formatter_class=argparse.ArgumentDefaultsHelpFormatter,
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
        help="also compute the Cramér-Rao bound given each true trajectory (default: no)",
    )
    campaign.add_argument(
        "--dtype",
        default=argparse.SUPPRESS,
        choices=["float32", "float64"],
        help="(default: float64)",
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
        help="replace it only if it is finished and had the same options",
    )
    parser.add_argument(
        "--block",
        type=int,
        help="number of runs computed together on each device (a CPU has one device a core); "
        "decides how much memory is used (default: 16 on a CPU, else by the memory)",
    )
    parser.add_argument(
        "--devices", default="all", help='"all", a number, or a platform: cpu, gpu (default: all)'
    )
    cache.add_options(parser)
    others = parser.add_argument_group(
        "several processes", "the same command for each process, with another --process-id"
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
    parser.add_argument("--dataset", required=True, help=f"one of: {', '.join(READERS)}")
    parser.add_argument("path", metavar="PATH", help="the file, or the folder, of the data set")
    parser.add_argument("--robot", type=int, help="number of the robot, where there are several")
    parser.add_argument(
        "--check-every",
        type=int,
        metavar="K",
        help="check after every K steps that the covariance is positive definite; 0: never; None: "
        "at 20 steps spread over the log",
    )
    cache.add_options(parser)
    parser.add_argument("--dtype", default="float64", choices=["float32", "float64"])
    parser.add_argument("--out", metavar="DIR", default=str(OUT), help="folder for results")
    parser.set_defaults(command=run_dataset)


def _add_verify(parser: argparse.ArgumentParser) -> None:
    """Add the options of `jaxslam verify`."""
    parser.add_argument(
        "target",
        metavar="FILE.py[:NAME]",
        nargs="?",
        help="a file that defines a Motion, a Sensor, or a function f and its f_jacobian",
    )
    parser.add_argument("--states", type=int, default=24, help="number of random states")
    parser.add_argument("--seed", type=int, default=0, help="seed of the random states")
    parser.add_argument("--out", metavar="DIR", default=str(OUT), help="folder for results")
    cache.add_options(parser)
    parser.set_defaults(command=verify_models, dtype="float64")


def _versions() -> str:
    """The versions of jaxslam, JAX and Python."""
    return (
        f"jaxslam {version('jaxslam')} (jax {jax.__version__}, Python {platform.python_version()})"
    )
