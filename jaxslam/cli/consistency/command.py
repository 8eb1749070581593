"""The command `jaxslam consistency`: a Monte-Carlo campaign, its table and its files."""

import argparse
import contextlib
import shutil
import sys
from collections.abc import Mapping
from dataclasses import replace

import jax

from jaxslam.cli.common import INTERRUPTED
from jaxslam.cli.consistency.folder import Earlier, earlier_results, open_store
from jaxslam.cli.consistency.run_zero import run_zero, write_films
from jaxslam.cli.consistency.spec import Spec, spec_of
from jaxslam.cli.user_objects import UserObjects
from jaxslam.consistency.campaign import Campaign, Interrupted, monte_carlo
from jaxslam.consistency.campaign.candidates import fitting_block
from jaxslam.core.protocols import Candidate
from jaxslam.results import campaign_files, store
from jaxslam.simulation.worlds import World


def consistency(options: argparse.Namespace, command: str) -> int:
    """Run a campaign, print its table and write its files; returns the exit status."""
    # Worlds are drawn in float64 whatever the filters compute in, so both precisions see the same.
    jax.config.update("jax_enable_x64", True)
    spec = spec_of(options)
    asked, part, user = spec.campaign, spec.part, UserObjects()
    scenario = user.scenario(asked.scenario, asked.steps)
    filters = user.filters(asked.filters, scenario)
    if part is not None:
        block = spec.block or fitting_block(scenario, filters, spec.devices[0])
        spec = replace(spec, block=block)
        if (part[0] - 1) * block * len(spec.devices) >= asked.runs:
            print(f"part {part[0]} of {part[1]} has no block of the {asked.runs:,} runs")
            return 0
    fresh = not spec.out.exists()
    keep = open_store(spec)
    earlier = None if part else earlier_results(spec.out, keep)
    try:
        with user.located_errors():
            campaign = monte_carlo(
                scenario,
                filters,
                asked.runs,
                jax.random.key(asked.seed),
                block=spec.block,
                devices=spec.devices,
                bound=asked.bound,
                dtype=asked.dtype,
                keep=keep,
                part=part,
            )
    except BaseException as stop:
        if part is None:  # other jobs may have saved some
            _remove_if_empty(keep, spec, fresh)
        if not isinstance(stop, Interrupted) or stop.campaign is None:
            raise
        print(stop.campaign)
        print(f"\njaxslam: interrupted, {stop}; --resume {spec.out} continues it", file=sys.stderr)
        return INTERRUPTED
    for sentence in keep.set_aside:
        print(f"jaxslam: {sentence}", file=sys.stderr)
    if part is not None:
        print(
            f"part {part[0]} of {part[1]} is done, {campaign.runs:,} runs; {keep.folder} holds "
            f"{keep.done():,} of {asked.runs:,}; jaxslam consistency --resume {spec.out} computes "
            "what is missing, and sums up"
        )
    else:
        if keep.set_aside:  # some runs were computed again
            earlier = None
        _write(spec, scenario, filters, campaign, earlier, command)
    return 0


def _remove_if_empty(keep: store.Store, spec: Spec, fresh: bool) -> None:
    """Delete the folder of a campaign without a finished block; fresh: that of the results, too."""
    if keep.spans():
        return
    shutil.rmtree(keep.folder, ignore_errors=True)
    if fresh:
        with contextlib.suppress(OSError):
            spec.out.rmdir()


def _write(
    spec: Spec,
    scenario: World,
    filters: Mapping[str, Candidate],
    campaign: Campaign,
    earlier: Earlier | None,
    command: str,
) -> None:
    """Print a campaign and write its files; those of a finished one stay as they are."""
    out, seed, took = spec.out, spec.campaign.seed, campaign.seconds
    ran = took - campaign.compile_seconds if campaign.compile_seconds else 0.0
    names = campaign_files.file_names(spec.figures) + [f"runs.{kind}" for kind in spec.tables]
    if earlier is not None:
        times = earlier._asdict()
        command = times.pop("command")
        campaign = replace(campaign, **times)
    print(campaign)
    if spec.animate:
        write_films(out, scenario, filters, seed, campaign.dtype)
    if earlier is not None and all((out / name).exists() for name in names):
        more = "but films" if spec.animate else "and nothing written"
        print(
            f"\n{out} holds this campaign, finished: nothing was run {more}; "
            f"--runs above {campaign.runs} extends it"
        )
        return
    if not campaign.first:
        name = campaign_files.filter_of_run_zero(campaign)
        first = run_zero(scenario, filters[name], seed, campaign.dtype)
        campaign = replace(campaign, first={name: first})
    paths = campaign_files.save_campaign(campaign, out, spec.figures, True, command, seed)
    paths += [campaign.save_runs(out / f"runs.{kind}") for kind in spec.tables]
    print("\nwrote " + ", ".join(map(str, paths)))
    print(
        f"results after {took:.1f} s"
        + f", {ran:.1f} s of them for the runs once all programs were compiled" * (ran > 0)
    )
