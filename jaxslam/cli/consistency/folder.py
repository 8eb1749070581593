"""The folder of a campaign's results: which campaign it holds, and its finished blocks of runs."""

import argparse
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from jaxslam.monte_carlo import missing
from jaxslam.results import store
from jaxslam.results.campaign_files import BLOCKS, RESULT


class CampaignOptions(NamedTuple):
    """The options that define a campaign, with their defaults."""

    scenario: str = "circle"
    filters: str = "dead_reckoning,ekf"
    runs: int = 100
    steps: int | None = None
    seed: int = 0
    bound: bool = False
    dtype: str = "float64"


class Earlier(NamedTuple):
    """Entries of the results that are not the same when a finished campaign is run again."""

    seconds: float
    compile_seconds: float
    step_seconds: dict[str, float]
    command: str


def earlier_results(out: Path, keep: store.Store) -> Earlier | None:
    """Those of a finished campaign in a folder; None without them or where runs miss."""
    assert keep.runs is not None
    if missing(keep.spans(), keep.runs, keep.runs):
        return None
    try:
        found = json.loads((out / RESULT).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    whole = isinstance(found, dict) and found.get("runs") == keep.runs
    if not whole or not set(Earlier._fields) <= found.keys():
        return None
    return Earlier(*(found[name] for name in Earlier._fields))


def _as_option(value: object) -> str:
    """The value of an option, as its user would write it."""
    if isinstance(value, bool):
        return "on" if value else "off"
    return "not given" if value is None else str(value)


def resumed(
    options: argparse.Namespace, there: store.Store, asked: Mapping[str, object]
) -> CampaignOptions:
    """The options of the campaign to be resumed; ValueError unless those given agree with them."""
    folder = options.resume
    if options.out is not None and options.out.resolve() != folder.resolve():
        raise ValueError(
            f"--resume: its results go to {folder}: expected no --out, got {options.out}"
        )
    told = there.settings.get("asked")
    if not isinstance(told, dict):
        raise ValueError(
            f"--resume: {folder} holds a campaign that was begun from Python; continue it there, "
            "with monte_carlo(keep=jaxslam.store.resume(folder))"
        )
    if differences := _differences(told, asked):
        raise ValueError(
            f"--resume: {folder} holds another campaign: {differences}: leave these "
            "options out to continue it, or begin another with --out in another folder"
        )
    done = there.done()
    if done > (runs := getattr(options, "runs", done)):
        raise ValueError(
            f"--runs: {folder} holds {done} runs: expected at least as many, got {runs}; leave "
            "--runs out to use all of them, or begin another campaign with --out in another folder"
        )
    return CampaignOptions(**(told | {"runs": there.runs} | dict(asked)))


def _differences(told: Mapping[str, object], asked: Mapping[str, object]) -> str:
    """Every option that is another in the campaign that was told."""
    return "; ".join(
        f"--{name} is {_as_option(told[name])} there, {_as_option(value)} here"
        for name, value in asked.items()
        if name in told and told[name] != value
    )


def open_store(
    options: argparse.Namespace,
    out: Path,
    asked: CampaignOptions,
    settings: Mapping[str, object],
    devices_of_part: int | None,
) -> store.Store:
    """The store of this campaign's blocks, in a new folder or in that of the resumed campaign.

    Args:
        settings: those that a resumed campaign began with; empty for another.
        devices_of_part: with how many devices a part of it is computed, where it is a part.
    """
    folder, runs = out / BLOCKS, asked.runs
    told = {name: value for name, value in asked._asdict().items() if name != "runs"}
    settings = settings or {"asked": told, "block": options.block}
    if devices_of_part is not None:
        return _joined(folder, {"devices": devices_of_part, **settings}, runs, options)
    if options.resume is None:
        _remove_old_blocks(options, out, settings, runs)
        store.create(folder, settings, runs)
    return store.resume(folder, settings, runs)


def _joined(
    folder: Path, settings: Mapping[str, object], runs: int, options: argparse.Namespace
) -> store.Store:
    """The store of a campaign whose parts independent processes compute."""
    if (folder / store.MANIFEST).exists():
        there = store.resume(folder).settings
        own = _flat(settings) | {"block": options.block}
        if "asked" in there and (found := _differences(_flat(there), own)):
            raise ValueError(
                f"--part: {folder.parent} holds another campaign: {found}: give all parts the same "
                "options, or begin another campaign with --out in another folder"
            )
        settings = there if options.resume is not None else settings
    elif (folder.parent / RESULT).exists():
        raise ValueError(
            f"--part: {folder.parent} holds the results of a campaign: choose another folder"
        )
    return store.join(folder, settings, runs)


def _flat(settings: Mapping[str, object]) -> dict[str, object]:
    """Settings with the options of the command beside the others."""
    asked = settings.get("asked")
    others = {name: value for name, value in settings.items() if name != "asked"}
    return (asked if isinstance(asked, dict) else {}) | others


def _remove_old_blocks(
    options: argparse.Namespace, out: Path, settings: Mapping[str, object], runs: int
) -> None:
    """Delete the blocks of an earlier campaign; raises ValueError unless the options allow it."""
    folder = out / BLOCKS
    if not (folder / store.MANIFEST).exists():
        if folder.exists() and not all(map(store.is_unfinished, folder.iterdir())):
            raise ValueError(
                f"--out: {folder} holds files that are no campaign's: choose another folder"
            )
        if (out / RESULT).exists() and not options.overwrite:
            raise ValueError(
                f"--out: {out} holds the results of a campaign: add --overwrite to replace them, "
                "or choose another folder"
            )
        return
    store.read_manifest(folder)  # raises where the folder is not a campaign's
    if not options.overwrite:
        there = store.resume(folder)
        done, whole = there.done(), there.runs or 0
        left = bool(missing(there.spans(), whole, max(whole, 1)))
        if left and done:
            raise ValueError(
                f"--out: {out} holds an unfinished campaign, with {done} of {whole} runs done: "
                f"--resume {out} continues it, --overwrite replaces it; or choose another folder"
            )
        same = options.again and (there.settings, whole) == (settings, runs)
        if done and (found := _differences(_flat(there.settings), _flat(settings))):
            raise ValueError(
                f"--out: {out} holds another campaign: {found}: choose another folder, or add "
                "--overwrite to replace it"
            )
        if done and not same:
            raise ValueError(
                f"--out: {out} holds a finished campaign of {done} runs: --resume {out} prints it, "
                "or extends it to more --runs, --overwrite replaces it; or choose another folder"
            )
    shutil.rmtree(folder)
