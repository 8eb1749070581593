"""The command `jaxslam draws`: the worlds of a campaign as tables, for any estimator."""

import argparse

import jax

from jaxslam._cli import cache
from jaxslam._cli.campaigns.campaign import (
    CampaignOptions,
    add_world_options,
    check_world_options,
)
from jaxslam._cli.user_objects import UserObjects
from jaxslam.consistency import write_draws
from jaxslam.consistency._draw_tables import check_tables, unsaid_settings
from jaxslam.consistency.campaign._progress import Progress
from jaxslam.results._files import check_writable

FOLDER = "draws"
"""Default folder of draws."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `jaxslam draws`."""
    group = parser.add_argument_group("worlds", "as those of `jaxslam consistency`")
    add_world_options(group)
    parser.add_argument(
        "--out",
        metavar="DIR",
        default=FOLDER,
        help="folder of the draws; the same command continues an interrupted one, and a larger "
        f"--runs extends it (default: {FOLDER})",
    )
    cache.add_options(parser)
    # Worlds are drawn in float64, as those of a campaign.
    parser.set_defaults(command=write_tables, dtype="float64")


def write_tables(options: argparse.Namespace, command: str) -> int:
    """Write the runs of a campaign as tables; returns the exit status."""
    names = ("scenario", "runs", "steps", "seed")
    chosen = CampaignOptions(**{n: v for n, v in vars(options).items() if n in names})
    check_world_options(chosen)
    check_writable(options.out)
    user = UserObjects()
    world = user.scenario(chosen.scenario, chosen.steps)
    check_tables(world)
    written = 0
    with user.located_errors(), Progress(world.name) as progress:

        def count(finished: int, runs: int) -> None:
            nonlocal written
            written = finished
            progress(finished, runs)

        try:
            write_draws(
                world,
                chosen.runs,
                jax.random.key(chosen.seed),
                options.out,
                options={name: getattr(chosen, name) for name in names} | {"command": command},
                progress=count,
            )
        except KeyboardInterrupt:
            text = (
                f"{options.out} has {written:,} of {chosen.runs:,} runs; the same command goes on"
            )
            raise KeyboardInterrupt(text if written else "") from None
    print(
        f"wrote {chosen.runs:,} runs of {world.name}, {world.steps:,} steps each, to "
        f"{options.out}; {options.out / 'README.md'} describes them"
    )
    if keys := unsaid_settings(world):
        print(
            f"dataset.toml cannot say {', '.join(keys)}, so jaxslam run refuses the folders: see "
            "the README"
        )
    return 0
