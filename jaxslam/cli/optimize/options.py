"""The options of `jaxslam optimize`."""

import argparse

from jaxslam.cli.common import add_dtype, add_out
from jaxslam.cli.optimize.command import ERRORS, SEVERAL, optimize_graph
from jaxslam.cli.runtime import cache
from jaxslam.graphs.solver.kernels import REGISTRY as KERNELS
from jaxslam.graphs.starts import STARTS


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
        f"{', '.join(SEVERAL)}, and the lowest robust cost is kept)",
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
        help="also prove, where it can be, that no poses have a lower chordal cost",
    )
    parser.add_argument(
        "--animate",
        action="store_true",
        help="also write a film of the iterations: film.html to step and play, and film.mp4, or "
        "film.gif where ffmpeg is missing",
    )
    cache.add_options(parser)
    add_dtype(parser)
    add_out(parser)
    parser.set_defaults(command=optimize_graph)
