"""The command `jaxslam consistency`: a Monte-Carlo campaign, its table and its files."""

import argparse
import contextlib
import shutil
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax

from jaxslam._cli import cache, model_checks
from jaxslam._cli.campaigns.campaign import (
    Spec,
    add_campaign_option,
    add_world_options,
    earlier_results,
    open_store,
    spec_of,
)
from jaxslam._cli.campaigns.engines import engine
from jaxslam._cli.common import (
    FAILED,
    INTERRUPTED,
    OUT,
    add_animate,
    add_figures,
    film_files,
    summary_table,
    write_results,
)
from jaxslam._cli.recorded.filter_choice import read_dataset
from jaxslam._cli.user_objects import UserObjects
from jaxslam.catalog import ALL
from jaxslam.consistency._model_check import LEAST
from jaxslam.consistency._verdict import is_faulty
from jaxslam.consistency.campaign import Campaign, Incomplete, Interrupted, monte_carlo
from jaxslam.consistency.campaign._block_programs import drive_run, fitting_block
from jaxslam.consistency.campaign._candidates import cast_floats
from jaxslam.core._names import closest_name
from jaxslam.core.protocols import Candidate
from jaxslam.datasets import READERS, Dataset
from jaxslam.results import _campaign_files as campaign_files
from jaxslam.results._campaign_files import FORMATS
from jaxslam.results._files import Files, Json
from jaxslam.results._report import verdict_on_twins
from jaxslam.simulation import Twin, twin
from jaxslam.simulation._worlds import World, world_of_run


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `jaxslam consistency`."""
    campaign = parser.add_argument_group(
        "campaign", "kept in the folder of results; --resume reads them there"
    )
    add_world_options(campaign)
    campaign.add_argument(
        "--like",
        metavar="FOLDER",
        default=argparse.SUPPRESS,
        help="worlds like a log, in place of --scenario: its smoothed path and map, its controls, "
        "what it saw in each row, with drawn noises; also compares statistics of the log with "
        "those of its twins",
    )
    campaign.add_argument(
        "--dataset",
        default=argparse.SUPPRESS,
        help=f"reader of --like, one of: {', '.join(READERS)} (default: table)",
    )
    campaign.add_argument(
        "--robot",
        type=int,
        default=argparse.SUPPRESS,
        help="number of the robot of --like, of several (default: the first)",
    )
    add_campaign_option(
        campaign,
        "filters",
        f'"all", or some of: {", ".join(ALL)}; and FILE.py:NAME, a Filter or a function of the '
        "scenario that returns one; comma-separated",
    )
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
    add_animate(parser, "of run 0 of each filter")
    parser.add_argument(
        "--compare",
        metavar="NAME",
        help="also compare every other filter with this one of --filters, run by run on the same "
        "draws: differences with intervals, in the table and on the page",
    )
    earlier = parser.add_mutually_exclusive_group()
    earlier.add_argument(
        "--resume",
        metavar="DIR",
        help="continue the campaign in a folder of results, with its options; a larger --runs "
        "extends it",
    )
    earlier.add_argument(
        "--overwrite", action="store_true", help="replace the campaign that is in the folder"
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
    parser.add_argument(
        "--executor",
        metavar="ENGINE",
        help="compute the blocks in other processes: processes:N, on this machine; "
        "dask://HOST:PORT, the workers of a Dask scheduler; mpi, the ranks of mpiexec "
        "(mpi4py.futures)",
    )
    parser.set_defaults(command=run_campaign)


class Plan(NamedTuple):
    """What a command computes."""

    spec: Spec
    scenario: World
    filters: Mapping[str, Candidate]
    data: Dataset | None
    """the log whose twins are the runs; None for runs of a scenario"""


def run_campaign(options: argparse.Namespace, command: str) -> int:
    """Run a campaign, print its table and write its files; returns the exit status.

    It is 1 where a filter is faulty, as not finite (`is_faulty`), or runs are missing; a verdict
    does not change it.
    """
    # Worlds are drawn in float64 whatever the filters compute in, so both precisions see the same.
    jax.config.update("jax_enable_x64", True)
    user = UserObjects()
    plan = plan_of(options, user)
    spec, runs, part = plan.spec, plan.spec.campaign.runs, plan.spec.part
    if part is not None:
        assert spec.block is not None
        if (part[0] - 1) * spec.block * len(spec.devices) >= runs:
            print(f"part {part[0]} of {part[1]} has no block of the {runs:,} runs")
            return 0

    keep = open_store(spec)
    earlier = None if part else earlier_results(spec.out, keep)
    try:
        with user.located_errors(), engine(options.executor) as (executor, workers):
            campaign = monte_carlo(
                plan.scenario,
                plan.filters,
                runs,
                jax.random.key(spec.campaign.seed),
                block=spec.block,
                devices=None if executor else spec.devices,
                workers=workers,
                bound=spec.campaign.bound,
                dtype=spec.campaign.dtype,
                keep=keep,
                part=part,
                executor=executor,
            )
    except BaseException as stop:
        if part is None and not keep.spans():  # other jobs may save some
            shutil.rmtree(keep.folder, ignore_errors=True)
            with contextlib.suppress(OSError):  # it has other files, as results
                spec.out.rmdir()
        return end_early(spec, stop)
    for sentence in keep.set_aside:
        print(f"jaxslam: {sentence}", file=sys.stderr)
    if part is not None:
        print(
            f"part {part[0]} of {part[1]} is done, {campaign.runs:,} runs; {keep.folder} holds "
            f"{keep.done():,} of {runs:,}; jaxslam consistency --resume {spec.out} computes "
            "what is missing, and sums up"
        )
        return 0

    if keep.set_aside:  # some runs were computed again
        earlier = None
    if plan.data is not None:
        campaign = replace(campaign, notes=(*campaign.notes, verdict_on_twins(campaign)))
    status = write_campaign(plan, campaign, earlier, command)
    if plan.data is not None:
        status = max(status, check_models(plan, earlier))
    is_wrong = any(is_faulty(summary.counts) for summary in campaign.filters.values())
    return FAILED if is_wrong else status


def plan_of(options: argparse.Namespace, user: UserObjects) -> Plan:
    """The checked options, with the scenario and the filters that they name.

    Prints the defaults that the reader of a log took.
    """
    if options.executor is not None and options.devices != "all":
        raise ValueError("--executor: each worker has one device: expected no --devices with it")
    spec = spec_of(options)
    campaign = spec.campaign
    data: Dataset | None = None
    scenario: World
    if campaign.like is not None:
        data = read_dataset(campaign.dataset, campaign.like, campaign.robot)
        if data.assumed:
            print(summary_table({"": {"defaults taken": list(data.assumed)}}), end="\n\n")
        scenario = twin(data)
    else:
        scenario = user.scenario(campaign.scenario, campaign.steps)
    filters = user.filters(campaign.filters, scenario)
    if spec.compare is not None:
        if spec.compare not in filters:
            raise ValueError(
                f"--compare: expected one of --filters, {', '.join(filters)}, got "
                f"{spec.compare!r}{closest_name(spec.compare, filters)}"
            )
        for option, count in (("filters", len(filters)), ("runs", campaign.runs)):
            if count < 2:
                raise ValueError(f"--compare: expected two --{option} or more, got {count}")
    if spec.part is not None:  # all parts divide the runs into the same blocks
        block = spec.block or fitting_block(scenario, filters, spec.devices[0])
        spec = replace(spec, block=block)
    return Plan(spec, scenario, filters, data)


def end_early(spec: Spec, stop: BaseException) -> int:
    """Print what a campaign has that was interrupted or lacks runs; returns the exit status.

    Any other error, and one that came before the first runs were done, is raised.
    """
    if isinstance(stop, Incomplete) and stop.campaign is None:
        raise ValueError(stop) from stop
    if not isinstance(stop, Interrupted | Incomplete) or stop.campaign is None:
        raise stop
    print(replace(stop.campaign, reference=spec.compare or ""))
    is_interrupted = isinstance(stop, Interrupted)
    print(
        f"\njaxslam: {'interrupted, ' * is_interrupted}{stop}; --resume {spec.out} continues it",
        file=sys.stderr,
    )
    return INTERRUPTED if is_interrupted else FAILED


def write_campaign(plan: Plan, campaign: Campaign, earlier: Json | None, command: str) -> int:
    """Print a campaign and write its files; returns the exit status.

    earlier: the results of a campaign that was finished earlier, whose files stay as they are.
    """
    spec, out, seed = plan.spec, plan.spec.out, plan.spec.campaign.seed
    reference = spec.compare
    if earlier is not None:
        # The command and the times are those of the runs, not of this look at them.
        command = str(earlier["command"])
        times: dict[str, Any] = {name: earlier[name] for name in campaign_files.TIMES}
        campaign = replace(campaign, **times)
        stored = campaign_files.reference_of(earlier)
        reference = stored if spec.compare is None else spec.compare
        if reference != stored:
            earlier = None  # its files have no such comparison
    campaign = replace(campaign, reference=reference or "")
    print(campaign)

    names = campaign_files.file_names(spec.figures)
    failed: list[str] = []
    if earlier is not None and all((out / name).exists() for name in names):
        written = "but films" if spec.animate else "and nothing written"
        print(
            f"\n{out} holds this campaign, finished: nothing was run {written}; "
            f"--runs above {campaign.runs} extends it"
        )
    else:
        if not campaign.first:
            # An earlier command computed run 0, which the figure of a run needs: run the first
            # filter with a map over it once more.
            mapping = [n for n, s in campaign.filters.items() if "rmse_landmarks" in s.measures]
            name = next(iter(mapping or campaign.filters))
            key = jax.random.key(seed)
            truth, log = cast_floats(world_of_run(plan.scenario, key, 0), campaign.dtype)
            trace = drive_run(plan.scenario, plan.filters[name], key, 0, truth, log)
            campaign = replace(campaign, first={name: jax.device_get((truth, trace.estimate))})
        paths = campaign_files.save_campaign(
            campaign, out, spec.figures, True, command, seed, failed.append
        )
        print("\nwrote " + ", ".join(map(str, paths)))
        for sentence in failed:
            print(f"jaxslam: {sentence}", file=sys.stderr)
    if spec.animate and write_films(out, plan.scenario, plan.filters, seed, campaign.dtype):
        return FAILED
    return FAILED if failed else 0


def write_films(
    out: Path, scenario: World, filters: Mapping[str, Candidate], seed: int, dtype: str
) -> int:
    """Write the film of run 0 of every filter, which runs once more; returns the exit status."""
    from jaxslam.results import plot  # matplotlib is slow to load

    def draw() -> Files:
        films = {
            name: plot.animate_world(
                scenario,
                candidate,
                jax.random.key(seed),
                dtype=dtype,
                title=f"{scenario.name}: {name}, run 0 of seed {seed}",
            )
            for name, candidate in filters.items()
        }
        return film_files(films, suffixed=True)

    return write_results(out, {}, {"film": draw})


def check_models(plan: Plan, earlier: Json | None) -> int:
    """Compare the log with its twins, which are the runs; returns the exit status.

    A check that was finished earlier stays as it is.
    """
    spec, campaign = plan.spec, plan.spec.campaign
    assert isinstance(plan.scenario, Twin)
    assert plan.data is not None
    if earlier is not None and (spec.out / model_checks.CHECK).exists():
        return 0
    if campaign.runs < LEAST:
        print(f"\nno check of the models, which takes --runs {LEAST} or more")
        return 0
    checks = model_checks.check_log(
        plan.scenario,
        plan.filters,
        plan.data.log,
        campaign.runs,
        jax.random.key(campaign.seed),
        devices=spec.devices,
        block=spec.block or fitting_block(plan.scenario, plan.filters, spec.devices[0]),
        dtype=campaign.dtype,
    )
    drawings = model_checks.check_drawings(checks, spec.figures)
    return write_results(spec.out, model_checks.check_files(checks), drawings)
