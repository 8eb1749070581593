"""The command `jaxslam`: the only place that parses arguments or configures JAX."""

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

import jax

from jaxslam.cli.campaign import consistency
from jaxslam.cli.dataset import run_dataset
from jaxslam.cli.models import verify_models
from jaxslam.datasets import READERS
from jaxslam.family import FILTERS
from jaxslam.scenarios import SCENARIOS

__all__ = ["main"]

USAGE_ERROR = 2
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
    check.add_argument("--out", type=Path, default=Path("out"), help="folder for results")
    check.set_defaults(command=verify_models, dtype="float64")

    for command in (judge, drive):
        command.add_argument("--dtype", default="float64", choices=["float32", "float64"])
        command.add_argument("--out", type=Path, default=Path("out"), help="folder for results")
    return parser
