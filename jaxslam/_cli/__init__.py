"""The command line `jaxslam`; only here are arguments parsed and JAX configured."""

import argparse
import atexit
import gc
import os
import re
import shlex
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

import jax
from threadpoolctl import threadpool_limits

from jaxslam._cli import cache, judge, optimize, verify
from jaxslam._cli.campaigns import consistency, draws
from jaxslam._cli.common import INTERRUPTED, CompileClock, as_folders, set_device_count
from jaxslam._cli.environment import environment_text
from jaxslam._cli.recorded import fit, laser_log, localize, make_map, run, slam
from jaxslam.core._names import closest_name
from jaxslam.core._optional import first_line

__all__ = ["main"]

USAGE_ERROR = 2
PIPE_CLOSED = 141  # 128 + SIGPIPE, as a shell reports it

_POSITIONAL = re.compile(r"-[\d.]")
"""A value that begins like a negative number, as in `--start -6,-10,90`, is not an option."""

COMMANDS = {
    "consistency": (
        consistency,
        "test filters for consistency in a Monte-Carlo campaign",
        "Run filters over the same simulated worlds and compare their errors with the covariances "
        "they claim. Prints a table and writes JSON, CSV and figures. The exit status is 1 if a "
        "filter is not finite, or its covariance not valid, in over 5 % of the runs, steps or ends "
        "of runs; verdicts do not change it.",
    ),
    "draws": (
        draws,
        "write the worlds of a campaign as tables, for an estimator in any language",
        "Write simulated runs as CSV files, with a README that has the equations of the world: "
        "what the robot records, and apart from it the truth. An estimator in any language reads "
        "them.",
    ),
    "judge": (
        judge,
        "judge estimators in any language by the draws of a campaign",
        "Compare the estimates of your own program, in any language, with the truth of `jaxslam "
        "draws`, by the tests of `jaxslam consistency`, and run filters of the library on the same "
        "draws. Prints a table and writes JSON, CSV, figures and a page. The exit status is 1 if "
        "an estimator has no finite estimate, or its covariance is not valid, in over 5 % of the "
        "runs, steps or ends of runs; verdicts do not change it.",
    ),
    "run": (
        run,
        "run filters on a recorded data set",
        "Run filters on recorded data. Prints a summary and writes trajectory, map, summary and a "
        "figure.",
    ),
    "fit": (
        fit,
        "fit noises and systematic errors of your data by maximum likelihood",
        "Find the standard deviations of motion and sensor, and with --calibrate systematic "
        "errors, by maximum likelihood, with standard errors, from a folder as of `jaxslam run "
        "--dataset table`. Prints a table and writes fit.json, and fit.toml, whose numbers replace "
        "those of dataset.toml.",
    ),
    "slam": (
        slam,
        "make a path and a map of a laser log",
        "Laser SLAM from raw odometry and scans. Prints a summary and writes trajectory, graph, "
        "loops, map and figures.",
    ),
    "map": (
        make_map,
        "make a map of a laser log from the poses in the file",
        "Make a map of a laser log at the poses in the file. Prints a summary and writes the map, "
        "as ROS reads it, and a figure.",
    ),
    "localize": (
        localize,
        "localize the robot of a laser log in a map",
        "Localize the robot in a map of ROS from raw odometry and scans, by particles. Prints a "
        "summary and writes trajectory and a figure.",
    ),
    "optimize": (
        optimize,
        "optimize a pose or landmark graph in a file",
        "Optimize a graph in a file of g2o or TORO. Prints a table and writes the poses, the "
        "optimized graph in g2o, a summary and a figure. The cost is "
        f"{optimize.COST} {optimize.ERRORS['pose'][1]}. The exit status is 1 if the optimization "
        "did not converge, 2 if the file cannot be used.",
    ),
    "verify": (
        verify,
        "verify the Jacobians of every model, or of your file",
        "Compare hand-derived Jacobians with forward and reverse autodiff and with difference "
        "quotients. Prints a table, or a report on your file, and writes JSON. The exit status is "
        "1 if anything fails, 2 if the file cannot be used.",
    ),
}
"""Module, line of help and description of each command."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status.

    0 on success, 1 for a wrong model or filter, an optimization that did not converge or a figure
    that could not be drawn, 2 on bad input, 130 if interrupted, 141 if the reader of the output has
    closed the pipe.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    # Python's last collection would visit every object of JAX, which takes over half a second.
    atexit.register(gc.freeze)
    if set(arguments) in ({"--version"}, {"--version", "--verbose"}):
        print(environment_text("--verbose" in arguments))
        return 0
    if arguments and arguments[0][:1] != "-" and arguments[0] not in COMMANDS:
        hint = f"{closest_name(arguments[0], COMMANDS)}; jaxslam --help lists the commands"
        print(f"jaxslam: unknown command {arguments[0]!r}{hint}", file=sys.stderr)
        return USAGE_ERROR
    try:
        arguments = _laser_command(arguments)
        options = _parser().parse_args(arguments)
    except SystemExit as stop:
        return int(stop.code or 0)
    try:
        as_folders(options)
        # By default a GPU rounds the factors of a float32 matrix product to 11 bits (TF32).
        jax.config.update("jax_default_matmul_precision", "highest")
        # Lowering without the Python frames of each operation takes a fifth less time.
        jax.config.update("jax_traceback_in_locations_limit", 0)
        if hasattr(options, "devices"):
            set_device_count(options.devices)
        else:
            jax.config.update("jax_enable_x64", options.dtype == "float64")
            if getattr(options, "check", False):  # twins are divided over the cores
                set_device_count("all")
        try:
            jax.devices()
        except Exception as error:  # RuntimeError or AssertionError of a plugin without its device
            raise ValueError(
                f"JAX finds no device, JAX_PLATFORMS={jax.config.jax_platforms or ''} "
                f"({first_line(error)}): JAX_PLATFORMS=cpu takes the processor"
            ) from error
        with CompileClock() as clock, cache.from_options(options), threadpool_limits(1, "blas"):
            status = int(options.command(options, shlex.join(["jaxslam", *arguments])))
            if status != INTERRUPTED:
                print(clock)
        sys.stdout.flush()  # here, so that a closed pipe is met below
        return status
    except BrokenPipeError:  # the reader, as `head`, has enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return PIPE_CLOSED
    except (ValueError, OSError) as error:
        print(f"jaxslam: {error}", file=sys.stderr)
        return USAGE_ERROR
    except KeyboardInterrupt as stop:
        # `write_results` says in the text which files it has written.
        files = str(stop) if type(stop) is KeyboardInterrupt else ""
        print(f"\njaxslam: interrupted; {files or 'nothing was written'}", file=sys.stderr)
        return INTERRUPTED


def _laser_command(arguments: list[str]) -> list[str]:
    """Replace `run --dataset carmen …`, or `rosbag`, by the command on a laser log.

    It is `localize MAP` with `--localize MAP`, `map` with `--map known`, else `slam`.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--dataset")
    parser.add_argument("--localize", metavar="MAP")
    parser.add_argument("--map", choices=("known",))
    words = set(" ".join(arguments).replace("=", " ").split())
    if arguments[:1] != ["run"] or not words & set(laser_log.READERS):
        return arguments
    chosen, others = parser.parse_known_args(arguments[1:])
    if chosen.dataset not in laser_log.READERS:
        return arguments
    others += ["--dataset", chosen.dataset]
    if chosen.localize is not None:
        return ["localize", chosen.localize, *others]
    return ["map" if chosen.map else "slam", *others]


class _Parser(argparse.ArgumentParser):
    """A parser with errors of one line, which does not complete abbreviated options."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **{"allow_abbrev": False, **options})
        self._negative_number_matcher = _POSITIONAL

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse as argparse does; unknown arguments are an error with the name of the command."""
        options, unknown = super().parse_known_args(args, namespace)
        if unknown:
            hint = closest_name(unknown[0], self._option_string_actions)
            self.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
        return options, unknown

    def error(self, message: str) -> NoReturn:
        """Exit with the error and a reference to the help."""
        hint = f"{self.prog} --help describes the options"
        self.exit(USAGE_ERROR, f"{self.prog}: {message}; {hint}\n")


def _parser() -> argparse.ArgumentParser:
    """The parser of the command line; `options.command` is the function to call."""
    parser = _Parser(
        prog="jaxslam",
        description="2-D SLAM in JAX: landmark filters and their consistency, graphs, laser maps.",
        epilog="jaxslam COMMAND --help describes the options of a command.",
    )
    parser.add_argument("--version", action="store_true", help="print the versions, and exit")
    parser.add_argument(
        "--verbose",
        action="store_true",
        help="with --version: all packages, devices and settings, for the report of a problem",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, (module, line, description) in COMMANDS.items():
        module.add_options(commands.add_parser(name, help=line, description=description))
    return parser
