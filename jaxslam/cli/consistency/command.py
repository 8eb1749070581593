"""The command `jaxslam consistency`: a Monte-Carlo campaign, its table and its files."""

import argparse
import contextlib
import re
import shutil
import sys
import threading
from collections.abc import Mapping
from dataclasses import replace

import jax

from jaxslam.cli.common import INTERRUPTED, OUT, check_out
from jaxslam.cli.consistency.film import write_films
from jaxslam.cli.consistency.folder import (
    CampaignOptions,
    earlier_results,
    open_store,
    resumed,
)
from jaxslam.cli.runtime import devices
from jaxslam.cli.user_objects import UserObjects
from jaxslam.core.numbers import check_count
from jaxslam.monte_carlo import Interrupted, monte_carlo
from jaxslam.monte_carlo.candidates import estimator_of, fitting_block, rounded
from jaxslam.protocols import Candidate
from jaxslam.results import campaign_files, report, store
from jaxslam.results.files import check_formats
from jaxslam.simulation.worlds import World, run_keys, world_of_run
from jaxslam.types import Estimate, Truth


def consistency(options: argparse.Namespace, command: str) -> int:
    """Run a campaign, print its table and write its files; returns the exit status."""
    asked, settings = _asked(options)
    part = _part(options)
    out = options.resume or options.out or OUT
    # Worlds are drawn in float64 whatever the filters compute in, so both precisions see the same.
    jax.config.update("jax_enable_x64", True)
    formats = campaign_files.check_figure_formats("--figures", options.figures.split(","))
    there = [kind for kind in report.RUN_FORMATS if (out / f"runs.{kind}").exists()]  # up to date
    asked_for = filter(None, options.table.split(","))
    tables = check_formats("--table", [*asked_for, *there], report.RUN_FORMATS)
    if asked.steps is not None:
        check_count("--steps", asked.steps)
    files = UserObjects()
    scenario = files.scenario(asked.scenario, asked.steps)
    filters = files.filters(asked.filters, scenario)
    if not 0 <= asked.seed < 2**32:
        raise ValueError(f"--seed: expected an integer from 0 to 2³²-1, got {asked.seed}")
    check_count("--runs", asked.runs)
    if options.block is not None:
        check_count("--block", options.block)
    check_out(out, "consistency")
    # What is missing of a campaign of parts is computed as the parts would.
    most = settings.get("devices")
    assert isinstance(most, int | None)
    here = devices.chosen_devices(options.devices, most)
    key = jax.random.key(asked.seed)
    if part is not None and options.block is None:
        options.block = fitting_block(scenario, filters, here[0])
    if part is not None and (part[0] - 1) * options.block * len(here) >= asked.runs:
        print(f"part {part[0]} of {part[1]} has no block of the {asked.runs:,} runs")
        return 0
    fresh = not out.exists()
    keep = open_store(options, out, asked, settings, part and len(here))
    earlier = None if part else earlier_results(out, keep)
    names = campaign_files.file_names(formats) + [f"runs.{kind}" for kind in tables]
    written = earlier is not None and all((out / name).exists() for name in names)
    if not written and part is None:
        # Matplotlib is loaded while filters run. Not in a daemon thread: such a thread crashes in
        # compiled code when the interpreter exits.
        threading.Thread(target=_prepare_drawing).start()
    try:
        with files.located_errors():
            campaign = monte_carlo(
                scenario,
                filters,
                asked.runs,
                key,
                block=options.block,
                devices=here,
                bound=asked.bound,
                dtype=asked.dtype,
                keep=keep,
                part=part,
            )
    except BaseException as stop:
        if not keep.spans() and part is None:  # other jobs may have saved some
            shutil.rmtree(keep.folder, ignore_errors=True)
            if fresh:
                with contextlib.suppress(OSError):
                    out.rmdir()
        if not isinstance(stop, Interrupted) or stop.campaign is None:
            raise
        print(stop.campaign)
        print(f"\njaxslam: interrupted, {stop}; --resume {out} continues it", file=sys.stderr)
        return INTERRUPTED
    for sentence in keep.set_aside:
        print(f"jaxslam: {sentence}", file=sys.stderr)
    if part is not None:
        print(
            f"part {part[0]} of {part[1]} is done, {campaign.runs:,} runs; {keep.folder} holds "
            f"{keep.done():,} of {asked.runs:,}; jaxslam consistency --resume {out} computes "
            "what is missing, and sums up"
        )
        return 0
    took = campaign.seconds
    ran = took - campaign.compile_seconds if campaign.compile_seconds else 0.0
    if earlier is not None and not keep.set_aside:  # else some runs were computed again
        campaign = replace(
            campaign,
            seconds=earlier.seconds,
            compile_seconds=earlier.compile_seconds,
            step_seconds=earlier.step_seconds,
        )
        command = earlier.command
    else:
        written = False
    print(campaign)
    film = ""
    if options.animate:
        films = write_films(out, scenario, filters, asked.seed, campaign.dtype)
        film = "" if written else next(iter(films.values())).player()
    if written:
        more = "but films" if options.animate else "and nothing written"
        print(
            f"\n{out} holds this campaign, finished: nothing was run {more}; "
            f"--runs above {campaign.runs} extends it"
        )
        return 0
    if not campaign.first:
        name = campaign_files.filter_of_run_zero(campaign)
        first = _run_zero(scenario, filters[name], key, campaign.dtype)
        campaign = replace(campaign, first={name: first})
    paths = campaign_files.save_campaign(campaign, out, formats, True, command, asked.seed, film)
    paths += [campaign.save_runs(out / f"runs.{kind}") for kind in tables]
    print("\nwrote " + ", ".join(map(str, paths)))
    print(
        f"results after {took:.1f} s"
        + f", {ran:.1f} s of them for the runs once all programs were compiled" * (ran > 0)
    )
    return 0


def _asked(options: argparse.Namespace) -> tuple[CampaignOptions, Mapping[str, object]]:
    """The options that define the campaign, and the settings that a resumed one began with.

    They come from the command, the resumed campaign and the defaults, in this order. The options of
    a resumed campaign get its size of blocks unless another is given.
    """
    asked = {n: value for n, value in vars(options).items() if n in CampaignOptions._fields}
    if options.resume is None:
        return CampaignOptions(**asked), {}
    there = store.resume(options.resume / campaign_files.BLOCKS)
    whole = resumed(options, there, asked)
    if options.block is None:  # blocks of another size would round differently
        options.block = there.settings.get("block")
    return whole, there.settings


def _part(options: argparse.Namespace) -> tuple[int, int] | None:
    """The part of the runs that is asked for, (i, n); raises ValueError where it is none."""
    if options.part is None:
        return None
    found = re.fullmatch(r"(\d+)/(\d+)", options.part, re.ASCII)
    if found is None or not 1 <= int(found[1]) <= int(found[2]):
        raise ValueError(f"--part: expected I/N with 1 <= I <= N, as 3/16, got {options.part!r}")
    for name, given in (("--overwrite", options.overwrite), ("--again", options.again)):
        if given:
            raise ValueError(f"--part: expected no {name} with it")
    return int(found[1]), int(found[2])


def _prepare_drawing() -> None:
    """Load what draws the figures."""
    from jaxslam.results import page, plot  # noqa: F401

    plot.warm_up()


def _run_zero(
    scenario: World, candidate: Candidate, key: jax.Array, dtype: str
) -> tuple[Truth, Estimate]:
    """Run 0 of a filter, computed again where an earlier command computed it."""
    truth, log = rounded(world_of_run(scenario, key, 0), dtype)
    method, _ = estimator_of(candidate, truth, scenario)
    estimate = method(log, run_keys(key, 0)[1]).estimate
    found: tuple[Truth, Estimate] = jax.device_get((truth, estimate))
    return found
