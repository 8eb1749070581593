"""The checked options of `jaxslam consistency`, and the folder of its results."""

import argparse
import json
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, get_args

import jax

from jaxslam._cli.common import OUT, check_out, chosen_devices
from jaxslam.consistency.campaign._pieces import missing_pieces
from jaxslam.core.validation import at_least, or_none, require
from jaxslam.results import _campaign_files as campaign_files
from jaxslam.results import store
from jaxslam.results._block_files import MANIFEST, is_unfinished, read_manifest
from jaxslam.results._campaign_files import BLOCKS, JUDGED, RESULT
from jaxslam.results._files import Json
from jaxslam.simulation.scenarios import SCENARIOS


class CampaignOptions(NamedTuple):
    """The options that define a campaign, with their defaults."""

    scenario: str = "circle"
    filters: str = "dead_reckoning,ekf"
    runs: int = 100
    steps: int | None = None
    seed: int = 0
    bound: bool = False
    dtype: str = "float64"
    like: str | None = None
    dataset: str = "table"
    robot: int | None = None


def add_world_options(group: argparse._ArgumentGroup) -> None:
    """Add the options of the worlds of a campaign, with the defaults of `CampaignOptions`."""
    scenarios = f"one of: {', '.join(SCENARIOS)}; or FILE.py:NAME, a Scenario or a function that "
    add_campaign_option(group, "scenario", scenarios + "returns one")
    add_campaign_option(group, "runs", "number of simulated trajectories")
    add_campaign_option(
        group, "steps", "number of steps of each trajectory; default: the scenario's own"
    )
    add_campaign_option(group, "seed", "seed of the random numbers")


def add_campaign_option(group: argparse._ArgumentGroup, name: str, text: str) -> None:
    """Add an option of a campaign, of the type of its field; it is absent from the options if left
    out, so that those of a folder take its place."""
    default, hint = getattr(CampaignOptions(), name), CampaignOptions.__annotations__[name]
    kind = (*get_args(hint), hint)[0]  # T of T | None
    text += "" if default is None else f" (default: {default})"
    group.add_argument(f"--{name}", type=kind, default=argparse.SUPPRESS, help=text)


def check_world_options(options: CampaignOptions) -> None:
    """Raise ValueError on numbers of steps or runs below 1, and on a seed out of range."""
    for name, count in (("steps", options.steps), ("runs", options.runs)):
        require(f"--{name}", count, or_none(at_least(1)))
    if not 0 <= options.seed < 2**32:
        raise ValueError(f"--seed: expected an integer from 0 to 2³²-1, got {options.seed}")


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
    """formats of the figures"""
    animate: bool
    compare: str | None
    """the filter with which every other is compared"""
    overwrite: bool
    settings: Mapping[str, object] = field(default_factory=dict)
    """settings stored by the campaign that is continued; empty for a new one"""


def spec_of(options: argparse.Namespace) -> Spec:
    """The checked options; a campaign that is continued supplies the options left out.

    Raises ValueError that names the option, and OSError where no file can be written.
    """
    campaign, settings, block = _campaign(options)
    out = options.resume or options.out or OUT
    formats = require("--figures", options.figures.split(","), campaign_files.formats_of_figures)
    check_world_options(campaign)
    require("--block", block, or_none(at_least(1)))
    part = None
    if options.part is not None:
        match = re.fullmatch(r"(\d+)/(\d+)", options.part, re.ASCII)
        if match is None or not 1 <= int(match[1]) <= int(match[2]):
            raise ValueError(
                f"--part: expected I/N with 1 <= I <= N, as 3/16, got {options.part!r}"
            )
        if options.overwrite:
            raise ValueError("--part: expected no --overwrite with it")
        part = int(match[1]), int(match[2])
    check_out(out, "consistency", draws=part is None)
    most = settings.get("devices")  # missing parts are computed as the parts would be
    assert isinstance(most, int | None)
    return Spec(
        campaign=campaign,
        out=out,
        devices=chosen_devices(options.devices, most),
        block=block,
        part=part,
        figures=formats,
        animate=options.animate,
        compare=options.compare,
        overwrite=options.overwrite,
        settings=settings,
    )


def _campaign(
    options: argparse.Namespace,
) -> tuple[CampaignOptions, Mapping[str, object], int | None]:
    """The options of the campaign, the settings stored by a campaign that is continued, and the
    size of its blocks.

    A folder that holds a campaign of the same options is continued. With --resume the options of
    that campaign replace those left out, else the defaults do.
    """
    chosen = {n: value for n, value in vars(options).items() if n in CampaignOptions._fields}
    if chosen.get("like") is not None:
        for name in ("scenario", "steps"):
            if name in chosen:
                raise ValueError(f"--{name}: expected none with --like, whose log has its own")
    elif options.resume is None and (of_log := {"dataset", "robot"} & chosen.keys()):
        raise ValueError(f"--{min(of_log)}: expected --like, too, the log that it is of")
    folder = options.resume or options.out or OUT
    if options.resume is None:
        chosen = CampaignOptions(**chosen)._asdict()
        if options.overwrite or not (folder / BLOCKS / MANIFEST).exists():
            return CampaignOptions(**chosen), {}, options.block
    elif options.out is not None and options.out.resolve() != folder.resolve():
        raise ValueError(
            f"--resume: its results go to {folder}: expected no --out, got {options.out}"
        )
    kept = store.resume(folder / BLOCKS)
    stored = kept.settings.get("asked")
    if kept.settings == JUDGED:
        raise ValueError(f"--resume: {folder} holds the results of jaxslam judge: judge again")
    if not isinstance(stored, dict):
        raise ValueError(
            f"--resume: {folder} holds a campaign that was begun from Python; continue it there, "
            "with monte_carlo(keep=jaxslam.store.resume(folder))"
        )
    if different := _differences(stored, chosen):
        option = "--out" if options.resume is None else "--resume"
        raise ValueError(
            f"{option}: {folder} holds another campaign: {different}: choose another folder with "
            "--out, or continue it with --resume and without these options, or replace it with "
            "--overwrite"
        )
    if (runs := chosen.get("runs")) is not None and runs < (kept.runs or 0):
        raise ValueError(
            f"--runs: the campaign in {folder} is to have {kept.runs} runs: expected at least as "
            f"many, got {runs}; --resume {folder} without --runs has all of them; or choose "
            "another folder"
        )
    # Blocks of another size would round differently.
    block = kept.settings.get("block") if options.block is None else options.block
    assert isinstance(block, int | None)
    return CampaignOptions(**(stored | {"runs": kept.runs} | chosen)), kept.settings, block


def _differences(stored: Mapping[str, object], options: Mapping[str, object]) -> str:
    """A phrase on each option whose stored value differs; "" if all agree."""
    return "; ".join(
        f"--{name} is {_as_option(stored[name])} there, {_as_option(value)} here"
        for name, value in options.items()
        if name in stored and stored[name] != value
    )


def _as_option(value: object) -> str:
    """The value of an option, as its user would write it."""
    if isinstance(value, bool):
        return "on" if value else "off"
    return "not given" if value is None else str(value)


def open_store(spec: Spec) -> store.Store:
    """The store of the campaign's blocks, in a new folder or in the folder that is continued."""
    out, folder = spec.out, spec.out / BLOCKS
    settings: Mapping[str, object] = spec.settings
    if spec.overwrite and (folder / MANIFEST).exists():
        read_manifest(folder)  # raises where the folder is not a campaign's
        shutil.rmtree(folder)
    if not settings:
        # Another part may have begun the campaign since the plan was made; `store.open` compares.
        is_joined = spec.part is not None and (folder / MANIFEST).exists()
        if folder.exists() and not is_joined and not all(map(is_unfinished, folder.iterdir())):
            raise ValueError(
                f"--out: {folder} holds files that are no campaign's: choose another folder"
            )
        if (out / RESULT).exists() and not spec.overwrite:
            raise ValueError(
                f"--out: {out} holds the results of a campaign: add --overwrite to replace them, "
                "or choose another folder"
            )
        # Without the number of runs, which --resume may raise.
        campaign = {name: v for name, v in spec.campaign._asdict().items() if name != "runs"}
        settings = {"asked": campaign, "block": spec.block}
        if spec.part is not None:
            settings = {"devices": len(spec.devices), **settings}
    elif spec.part is not None:
        # All parts must divide the runs into the same blocks.
        division = {"block": spec.block, "devices": len(spec.devices)}
        if different := _differences({"devices": None, **settings}, division):
            raise ValueError(
                f"--part: {out} holds another campaign: {different}: give all parts the same "
                "options, or begin another campaign with --out in another folder"
            )
    return store.open(folder, settings, spec.campaign.runs)


def earlier_results(out: Path, keep: store.Store) -> Json | None:
    """The results of a finished campaign in a folder; None without one, or if runs are missing."""
    assert keep.runs is not None
    if missing_pieces(keep.spans(), keep.runs, keep.runs):
        return None
    try:
        result: Json = json.loads((out / RESULT).read_text(encoding="utf-8"))
        return result if result["runs"] == keep.runs else None
    except (OSError, ValueError, LookupError, TypeError):
        return None
