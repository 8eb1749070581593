"""The options of `jaxslam consistency`."""

import argparse

from jaxslam.catalog import ALL
from jaxslam.cli import films
from jaxslam.cli.common import OUT, add_figures
from jaxslam.cli.consistency.command import consistency
from jaxslam.cli.consistency.spec import CampaignOptions
from jaxslam.cli.runtime import cache
from jaxslam.results.campaign_files import FORMATS
from jaxslam.results.report import RUN_FORMATS
from jaxslam.simulation.scenarios import SCENARIOS


def add_options(parser: argparse.ArgumentParser) -> None:
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
        default = getattr(CampaignOptions(), name)
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
    add_figures(parser, FORMATS, "; the page always has its own")
    parser.add_argument(
        "--table",
        default="",
        metavar="FORMATS",
        help=f"also write each run's averages as runs.csv, …; formats of {', '.join(RUN_FORMATS)}",
    )
    films.add_options(parser)
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
    parser.set_defaults(command=consistency)
