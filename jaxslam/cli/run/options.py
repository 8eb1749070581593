"""The options of `jaxslam run`."""

import argparse

from jaxslam.cli import films
from jaxslam.cli.common import add_dtype, add_figures, add_out
from jaxslam.cli.laser import options as laser_options
from jaxslam.cli.run.command import run_dataset
from jaxslam.cli.run.filters import NAMES
from jaxslam.cli.runtime import cache
from jaxslam.datasets import READERS
from jaxslam.datasets.table.models import METHODS
from jaxslam.results.campaign_files import FORMATS


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `jaxslam run`."""
    known = ", ".join([*READERS, *laser_options.READERS])
    parser.add_argument("--dataset", required=True, help=f"one of: {known}")
    parser.add_argument("path", metavar="PATH", help="the file, or the folder, of the data set")
    parser.add_argument(
        "--robot",
        type=int,
        help="number of the robot, where there are several (default: the first)",
    )
    parser.add_argument(
        "--filters",
        help=f"some of: {', '.join(NAMES)}; with commas between them (default: ekf)",
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
    add_figures(parser, FORMATS)
    films.add_options(parser)
    cache.add_options(parser)
    add_dtype(parser, " of the filter")
    add_out(parser)
    laser_options.add_options(parser)
    parser.set_defaults(command=run_dataset)
