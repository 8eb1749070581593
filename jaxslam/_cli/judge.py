"""The command `jaxslam judge`: estimators of any kind on the draws of `jaxslam draws`, or the
covariances that a recorded robot published."""

import argparse
import re
import shutil
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from jaxslam._cli import cache
from jaxslam._cli.campaigns.estimator_runs import Programs
from jaxslam._cli.common import FAILED, add_figures, add_out, check_out, chosen_devices
from jaxslam._cli.recorded import judge_recording
from jaxslam._cli.user_objects import UserObjects
from jaxslam.consistency._verdict import is_faulty
from jaxslam.consistency.campaign import Campaign
from jaxslam.consistency.campaign._judging import judge_sources
from jaxslam.consistency.campaign._pieces import cores
from jaxslam.consistency.campaign._run_estimates import RunFault
from jaxslam.core._names import closest_name
from jaxslam.core.protocols import Candidate
from jaxslam.core.validation import at_least, or_none, positive, require
from jaxslam.datasets._judged_folders import DrawsFolder, folder_source, read_draws, run_name
from jaxslam.results import _campaign_files as campaign_files
from jaxslam.results import store
from jaxslam.results._block_files import MANIFEST, is_unfinished
from jaxslam.results._campaign_files import BLOCKS, FORMATS, JUDGED
from jaxslam.simulation._worlds import World

FOLDER = "estimates"
"""Default folder of the estimates that the command computes."""

_OF_ESTIMATES: dict[str, tuple[str, object]] = {
    "ESTIMATES": ("estimates", []),
    "--draws": ("draws", None),
    "--estimator": ("estimator", None),
    "--time-limit": ("time_limit", None),
    "--processes": ("processes", None),
    "--filters": ("filters", ""),
    "--every": ("stride", 1),
    "--compare": ("compare", None),
    "--runs": ("runs", None),
    "--bound": ("bound", False),
}
"""Field and default of each option that a recording does not have."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `jaxslam judge`."""
    parser.add_argument(
        "estimates",
        nargs="*",
        metavar="ESTIMATES",
        help="folders of estimates, one for each estimator: ESTIMATES/0000/trajectory.csv is of "
        "run 0000, and so on, as `jaxslam run` writes it; map.csv and innovations.csv are optional "
        f"(default with --estimator: {FOLDER})",
    )
    parser.add_argument(
        "--draws", metavar="DIR", help="the folder of `jaxslam draws` that was estimated"
    )
    parser.add_argument(
        "--estimator",
        metavar="COMMAND",
        help="run this program first, once for each run without an estimate, as './my_filter {run} "
        "{estimate}': {run} is the folder of the run, {estimate} an empty folder for its estimate",
    )
    parser.add_argument(
        "--time-limit",
        type=float,
        metavar="SECONDS",
        help="time after which the program of a run is killed (default: none)",
    )
    parser.add_argument(
        "--processes",
        type=int,
        metavar="N",
        help="programs that run at once (default: as many as cores)",
    )
    parser.add_argument(
        "--filters",
        default="",
        help="filters of the library as further columns on the same draws, as in jaxslam "
        "consistency; comma-separated (default: none)",
    )
    parser.add_argument(
        "--every",
        dest="stride",
        type=int,
        default=1,
        metavar="K",
        help="judge each K-th step alone, where an estimator writes fewer rows; of filters, too "
        "(default: 1)",
    )
    parser.add_argument(
        "--compare",
        metavar="NAME",
        help="also compare every other column with this one, of ESTIMATES or --filters, run by run "
        "on the same draws: differences with intervals, in the table and on the page",
    )
    parser.add_argument("--runs", type=int, help="judge the first runs alone (default: all)")
    parser.add_argument(
        "--bound",
        action="store_true",
        help="also compute the Cramér-Rao bound conditional on each true trajectory",
    )
    add_out(parser)
    add_figures(parser, FORMATS, "; the page always has its own")
    parser.add_argument(
        "--devices", default="all", help='"all", a number, or a platform: cpu, gpu (default: all)'
    )
    cache.add_options(parser)
    judge_recording.add_arguments(parser)
    parser.set_defaults(command=run_judge)


class JudgePlan(NamedTuple):
    """What `jaxslam judge` judges: folders of estimates, and filters, on a folder of draws."""

    draws: DrawsFolder
    folders: dict[str, Path]
    """by name, which are the columns of the table"""
    world: World
    filters: Mapping[str, Candidate]
    runs: int
    devices: list[jax.Device]
    figures: tuple[str, ...]
    """formats of the figures"""


def run_judge(options: argparse.Namespace, command: str) -> int:
    """Judge estimates or a recording, print the table and write its files; the exit status.

    It is 1 where an estimator or a filter is faulty, as not finite (`is_faulty`), or a figure
    cannot be drawn; a verdict does not change it.
    """
    is_recording = options.estimate is not None or options.truth is not None
    others = _OF_ESTIMATES if is_recording else judge_recording.OPTIONS
    for label, (field, default) in others.items():
        if getattr(options, field) != default:
            beside = "beside" if is_recording else "without"
            raise ValueError(f"{label}: expected none {beside} --estimate and --truth")
    if is_recording:
        return judge_recording.run(options, command)

    jax.config.update("jax_enable_x64", True)
    user = UserObjects()
    plan = plan_of(options, user)
    campaign, columns = judge_folders(plan, options, user)
    print(campaign)
    # The numbers first: what an interrupted command leaves has no runs of another campaign.
    blocks = options.out / BLOCKS
    shutil.rmtree(blocks, ignore_errors=True)
    failed: list[str] = []
    paths = campaign_files.save_campaign(
        campaign, options.out, plan.figures, True, command, None, failed.append
    )
    kept = store.open(blocks, JUDGED, campaign.runs)
    kept.claim({"filters": ", ".join(campaign.filters), "steps": str(campaign.steps)})
    kept.save(0, columns, campaign.runs)
    print("\nwrote " + ", ".join(map(str, paths)))
    for sentence in failed:
        print(f"jaxslam: {sentence}", file=sys.stderr)
    is_wrong = any(is_faulty(summary.counts) for summary in campaign.filters.values())
    return FAILED if is_wrong or failed else 0


def plan_of(options: argparse.Namespace, user: UserObjects) -> JudgePlan:
    """The checked options, with the draws, the world and the filters that they name."""
    formats = require("--figures", options.figures.split(","), campaign_files.formats_of_figures)
    if not options.estimates and options.estimator is not None:
        options.estimates = [FOLDER]
    if not options.estimates:
        raise ValueError("ESTIMATES: expected a folder of estimates, got none")
    if options.draws is None:
        raise ValueError("--draws: expected the folder of `jaxslam draws`, got none")
    folders: dict[str, Path] = {}
    for folder in map(Path, options.estimates):
        name = folder.resolve().name
        if name in folders:
            raise ValueError(
                f"ESTIMATES: expected folders of different names, got {folders[name]} and {folder}"
            )
        folders[name] = folder
    draws = read_draws(Path(options.draws))
    runs = draws.runs if options.runs is None else options.runs
    for name, field in (("runs", "runs"), ("every", "stride"), ("processes", "processes")):
        require(f"--{name}", getattr(options, field), or_none(at_least(1)))
    if runs > draws.runs:
        raise ValueError(f"--runs: expected at most {draws.runs}, as {options.draws} has")
    require("--time-limit", options.time_limit, or_none(positive))
    world = user.scenario(draws.scenario, draws.steps)
    if world.steps % options.stride:
        raise ValueError(
            f"--every: expected a divisor of the {world.steps} steps, got {options.stride}"
        )
    filters = user.filters(options.filters, world) if options.filters.strip() else {}
    if twice := [name for name in folders if name in filters]:
        raise ValueError(
            f"ESTIMATES: {twice[0]} is the name of a filter: expected a folder of another name"
        )
    if options.compare is not None:
        names = [*folders, *filters]
        if options.compare not in names:
            raise ValueError(
                f"--compare: expected one of ESTIMATES and --filters, {', '.join(names)}, got "
                f"{options.compare!r}{closest_name(options.compare, names)}"
            )
        for counted, count in (("columns", len(names)), ("runs", runs)):
            if count < 2:
                raise ValueError(f"--compare: expected two {counted} or more, got {count}")
    devices = chosen_devices(options.devices)
    check_out(options.out, "judge")
    blocks = options.out / BLOCKS
    # They are replaced at the end, so nothing else may be there.
    if (blocks / MANIFEST).exists():
        if store.resume(blocks).settings != JUDGED:
            raise ValueError(f"--out: {options.out} holds a campaign: choose another folder")
    elif blocks.exists() and not all(map(is_unfinished, blocks.iterdir())):
        raise ValueError(f"--out: {blocks} is none of jaxslam judge: choose another folder")
    if options.estimator is not None and len(folders) > 1:
        raise ValueError(f"--estimator: expected one folder of estimates, got {len(folders)}")
    return JudgePlan(draws, folders, world, filters, runs, devices, formats)


def judge_folders(
    plan: JudgePlan, options: argparse.Namespace, user: UserObjects
) -> tuple[Campaign, dict[str, np.ndarray]]:
    """The campaign of the estimates in all folders, and its numbers by run for a store.

    The estimates are computed first if the user has a program for that.
    """
    draws = plan.draws
    columns: dict[str, np.ndarray] = {}
    failures: dict[int, RunFault] = {}
    if options.estimator is not None:
        (folder,) = plan.folders.values()
        program = Programs(options.estimator, draws, folder, options.time_limit)
        failures = program.run(range(plan.runs), options.processes or cores())
    names = {run_name(number) for number in range(draws.runs)}
    for folder in plan.folders.values():
        content = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
        if further := sorted(n for n in content - names if re.fullmatch(r"\d{4,}", n, re.ASCII)):
            raise ValueError(
                f"{folder / further[0]}: {draws.path} has runs {run_name(0)} to "
                f"{run_name(draws.runs - 1)} alone"
            )
        if not content & names and not failures:
            problem = "holds no estimate" if folder.is_dir() else "is no folder"
            raise ValueError(
                f"{folder} {problem}: expected {run_name(0)}/trajectory.csv, and so on, for each "
                f"run of {draws.path}"
            )
    measured, state = plan.world.sensor.measurements, plan.world.motion.state
    sources = {
        name: folder_source(folder, draws, measured, options.stride, failures, state)
        for name, folder in plan.folders.items()
    }
    with user.located_errors():
        campaign = judge_sources(
            plan.world,
            sources,
            plan.runs,
            draws.key,
            filters=plan.filters,
            stride=options.stride,
            bound=options.bound,
            devices=plan.devices,
            save=columns.update,
        )
    return replace(campaign, reference=options.compare or ""), columns
