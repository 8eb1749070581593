"""What a call of `jaxslam consistency` asks for: the campaign, and where and how to compute it."""

import argparse
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import jax

from jaxslam.cli.common import OUT, check_out
from jaxslam.cli.runtime import devices
from jaxslam.core.numbers import check_count
from jaxslam.results import campaign_files, report, store
from jaxslam.results.files import check_formats


class CampaignOptions(NamedTuple):
    """The options that define a campaign, with their defaults."""

    scenario: str = "circle"
    filters: str = "dead_reckoning,ekf"
    runs: int = 100
    steps: int | None = None
    seed: int = 0
    bound: bool = False
    dtype: str = "float64"


@dataclass(frozen=True)
class Spec:
    """The checked options of one call."""

    campaign: CampaignOptions
    out: Path
    devices: list[jax.Device]
    block: int | None
    """runs computed together on a device"""
    part: tuple[int, int] | None
    """(i, n): compute part i of n alone"""
    figures: tuple[str, ...]
    tables: tuple[str, ...]
    """formats of the figures, and of the tables of runs"""
    animate: bool
    resume: bool
    overwrite: bool
    again: bool
    settings: Mapping[str, object] = field(default_factory=dict)
    """those that a resumed campaign began with"""


def spec_of(options: argparse.Namespace) -> Spec:
    """The checked options; a resumed campaign supplies those that are not given.

    Raises ValueError that names the option, and OSError where no file can be written.
    """
    campaign, settings, block = _campaign(options)
    out = options.resume or options.out or OUT
    formats = campaign_files.check_figure_formats("--figures", options.figures.split(","))
    existing = [kind for kind in report.RUN_FORMATS if (out / f"runs.{kind}").exists()]
    given = filter(None, options.table.split(","))
    tables = check_formats("--table", [*given, *existing], report.RUN_FORMATS)
    for name, count in (("steps", campaign.steps), ("runs", campaign.runs), ("block", block)):
        if count is not None:
            check_count(f"--{name}", count)
    if not 0 <= campaign.seed < 2**32:
        raise ValueError(f"--seed: expected an integer from 0 to 2³²-1, got {campaign.seed}")
    part = _part(options)
    check_out(out, "consistency")
    most = settings.get("devices")  # missing parts are computed as the parts would be
    assert isinstance(most, int | None)
    return Spec(
        campaign=campaign,
        out=out,
        devices=devices.chosen_devices(options.devices, most),
        block=block,
        part=part,
        figures=formats,
        tables=tables,
        animate=options.animate,
        resume=options.resume is not None,
        overwrite=options.overwrite,
        again=options.again,
        settings=settings,
    )


def _campaign(
    options: argparse.Namespace,
) -> tuple[CampaignOptions, Mapping[str, object], int | None]:
    """The campaign, the settings that a resumed one began with, and the size of its blocks.

    Options come from the command, the resumed campaign and the defaults, in this order.
    """
    given = {n: value for n, value in vars(options).items() if n in CampaignOptions._fields}
    folder, block = options.resume, options.block
    if folder is None:
        return CampaignOptions(**given), {}, block
    kept = store.resume(folder / campaign_files.BLOCKS)
    if options.out is not None and options.out.resolve() != folder.resolve():
        raise ValueError(
            f"--resume: its results go to {folder}: expected no --out, got {options.out}"
        )
    stored = kept.settings.get("asked")
    if not isinstance(stored, dict):
        raise ValueError(
            f"--resume: {folder} holds a campaign that was begun from Python; continue it there, "
            "with monte_carlo(keep=jaxslam.store.resume(folder))"
        )
    if different := differences(stored, given):
        raise ValueError(
            f"--resume: {folder} holds another campaign: {different}: leave these "
            "options out to continue it, or begin another with --out in another folder"
        )
    done = kept.done()
    if done > (runs := given.get("runs", done)):
        raise ValueError(
            f"--runs: {folder} holds {done} runs: expected at least as many, got {runs}; leave "
            "--runs out to use all of them, or begin another campaign with --out in another folder"
        )
    if block is None:  # blocks of another size would round differently
        block = kept.settings.get("block")
    return CampaignOptions(**(stored | {"runs": kept.runs} | given)), kept.settings, block


def _part(options: argparse.Namespace) -> tuple[int, int] | None:
    """The part (i, n) of the runs that --part names; ValueError where it is none."""
    if options.part is None:
        return None
    found = re.fullmatch(r"(\d+)/(\d+)", options.part, re.ASCII)
    if found is None or not 1 <= int(found[1]) <= int(found[2]):
        raise ValueError(f"--part: expected I/N with 1 <= I <= N, as 3/16, got {options.part!r}")
    for name, given in (("--overwrite", options.overwrite), ("--again", options.again)):
        if given:
            raise ValueError(f"--part: expected no {name} with it")
    return int(found[1]), int(found[2])


def differences(stored: Mapping[str, object], given: Mapping[str, object]) -> str:
    """A phrase on every option whose stored value is another; "" where all agree."""
    return "; ".join(
        f"--{name} is {_as_option(stored[name])} there, {_as_option(value)} here"
        for name, value in given.items()
        if name in stored and stored[name] != value
    )


def _as_option(value: object) -> str:
    """The value of an option, as its user would write it."""
    if isinstance(value, bool):
        return "on" if value else "off"
    return "not given" if value is None else str(value)
