"""The command `jaxslam`: the only place that parses arguments or configures JAX."""

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
from jaxslam.cli.asking import INTERRUPTED, as_folders
from jaxslam.cli.campaign import DEFAULTS, OUT, consistency
from jaxslam.cli.dataset import run_dataset
from jaxslam.cli.models import verify_models
from jaxslam.cli.spent import Spent
from jaxslam.datasets import READERS
from jaxslam.simulation.scenarios import SCENARIOS

__all__ = ["main"]

USAGE_ERROR = 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 on success, 1 for a wrong model, 2 on bad input, 130 if interrupted."""
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
        with Spent() as spent, cache.asked_for(options), threadpool_limits(1, "blas"):
            status = int(options.command(options, shlex.join(["jaxslam", *arguments])))
            if status != INTERRUPTED and jax.process_index() == 0:
                print(spent)
        return status
    except (ValueError, OSError) as error:
        print(f"jaxslam: {error}", file=sys.stderr)
        return USAGE_ERROR
    except KeyboardInterrupt:
        print("\njaxslam: interrupted; nothing was written", file=sys.stderr)
        return INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="jaxslam", description="2-D landmark SLAM in JAX.")
    parser.add_argument("--version", action="version", version=_versions())
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    judge = commands.add_parser(
        "consistency",
        help="is a filter honest? a Monte-Carlo campaign",
        description="Run filters over the same simulated worlds and compare their errors with the "
        "covariances they claim. Prints a table and writes JSON, CSV and figures.",
    )
    asked = judge.add_argument_group(
        "what", "kept in the folder of results; --resume reads it there"
    )
    for name, about in {
        "scenario": f"one of: {', '.join(SCENARIOS)}",
        "filters": f'"all", or some of: {",".join(ALL)}; comma-separated',
        "runs": "simulated trajectories",
        "steps": "steps of each; default the scenario's own",
        "seed": "of every draw",
    }.items():
        default = DEFAULTS[name]
        kind = str if isinstance(default, str) else int
        about += "" if default is None else f" (default: {default})"
        asked.add_argument(f"--{name}", type=kind, default=argparse.SUPPRESS, help=about)
    asked.add_argument(
        "--bound",
        action=argparse.BooleanOptionalAction,
        default=argparse.SUPPRESS,
        help="also the Cramér-Rao bound given each true trajectory (default: no)",
    )
    asked.add_argument(
        "--dtype",
        default=argparse.SUPPRESS,
        choices=["float32", "float64"],
        help="(default: float64)",
    )
    judge.add_argument(
        "--out", metavar="DIR", help=f"folder for results (default: {OUT}; with --resume, its own)"
    )
    there = judge.add_mutually_exclusive_group()
    there.add_argument(
        "--resume",
        metavar="DIR",
        help="go on with the campaign in a folder of results; with a larger --runs, extend it",
    )
    there.add_argument(
        "--overwrite", action="store_true", help="give up the campaign that is in the folder"
    )
    there.add_argument(
        "--again",
        action="store_true",
        help="give it up where it is finished and was asked for by the same options",
    )
    judge.add_argument(
        "--block",
        type=int,
        help="runs computed together on each device, of which a CPU has one a core; sets memory "
        "(default: 16 on a CPU, on an accelerator by its memory)",
    )
    judge.add_argument(
        "--devices", default="all", help='"all", a number, or a platform: cpu, gpu (default: all)'
    )
    cache.add_options(judge)
    others = judge.add_argument_group(
        "several processes", "the same command on each, but for the id"
    )
    others.add_argument(
        "--coordinator",
        metavar="HOST:PORT",
        help='where process 0 listens; "auto" for SLURM, Kubernetes, Open MPI',
    )
    others.add_argument("--processes", type=int, metavar="P", help="how many there are")
    others.add_argument("--process-id", type=int, metavar="I", help="which one this is, from 0")
    others.add_argument(
        "--timeout", type=int, default=60, help="seconds to wait for the others (default: 60)"
    )
    judge.set_defaults(command=consistency)

    drive = commands.add_parser(
        "run",
        help="EKF-SLAM on a data set",
        description="Run EKF-SLAM on recorded data; writes trajectory, map, summary and a picture.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    drive.add_argument("--dataset", required=True, help=f"one of: {', '.join(READERS)}")
    drive.add_argument("path", metavar="PATH", help="the file, or the folder, of the data set")
    drive.add_argument("--robot", type=int, help="which robot, where a data set has several")
    drive.add_argument(
        "--check-every",
        type=int,
        metavar="K",
        help="is the covariance positive definite? look after every K steps, 0 never; None: at 20 "
        "steps spread over the log",
    )
    drive.set_defaults(command=run_dataset)

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
    check.add_argument("--out", metavar="DIR", default=str(OUT), help="folder for results")
    check.set_defaults(command=verify_models, dtype="float64")

    for command in (drive, check):
        cache.add_options(command)
    drive.add_argument("--dtype", default="float64", choices=["float32", "float64"])
    drive.add_argument("--out", metavar="DIR", default=str(OUT), help="folder for results")
    return parser


def _versions() -> str:
    return (
        f"jaxslam {version('jaxslam')} (jax {jax.__version__}, Python {platform.python_version()})"
    )
