"""The folder of a campaign's results: which campaign it holds, and its finished blocks of runs."""

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from jaxslam.cli.consistency.spec import Spec, differences
from jaxslam.consistency.campaign import missing
from jaxslam.results import store
from jaxslam.results.campaign_files import BLOCKS, RESULT


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


def open_store(spec: Spec) -> store.Store:
    """The store of the campaign's blocks, in a new folder or in that of the resumed campaign."""
    folder, runs = spec.out / BLOCKS, spec.campaign.runs
    asked = {name: value for name, value in spec.campaign._asdict().items() if name != "runs"}
    settings = spec.settings or {"asked": asked, "block": spec.block}
    if spec.part is not None:
        return _join(folder, {"devices": len(spec.devices), **settings}, spec)
    if not spec.resume:
        _remove_old_blocks(spec, settings)
        store.create(folder, settings, runs)
    return store.resume(folder, settings, runs)


def _join(folder: Path, settings: Mapping[str, object], spec: Spec) -> store.Store:
    """The store of a campaign whose parts independent processes compute."""
    if (folder / store.MANIFEST).exists():
        stored = store.resume(folder).settings
        given = _flat(settings) | {"block": spec.block}
        if "asked" in stored and (different := differences(_flat(stored), given)):
            raise ValueError(
                f"--part: {spec.out} holds another campaign: {different}: give all parts the same "
                "options, or begin another campaign with --out in another folder"
            )
        settings = stored if spec.resume else settings
    elif (spec.out / RESULT).exists():
        raise ValueError(
            f"--part: {spec.out} holds the results of a campaign: choose another folder"
        )
    return store.join(folder, settings, spec.campaign.runs)


def _flat(settings: Mapping[str, object]) -> dict[str, object]:
    """Settings with the options of the command beside the others."""
    asked = settings.get("asked")
    others = {name: value for name, value in settings.items() if name != "asked"}
    return (asked if isinstance(asked, dict) else {}) | others


def _remove_old_blocks(spec: Spec, settings: Mapping[str, object]) -> None:
    """Delete the blocks of an earlier campaign; raises ValueError unless the options allow it."""
    out, folder = spec.out, spec.out / BLOCKS
    if not (folder / store.MANIFEST).exists():
        if folder.exists() and not all(map(store.is_unfinished, folder.iterdir())):
            raise ValueError(
                f"--out: {folder} holds files that are no campaign's: choose another folder"
            )
        if (out / RESULT).exists() and not spec.overwrite:
            raise ValueError(
                f"--out: {out} holds the results of a campaign: add --overwrite to replace them, "
                "or choose another folder"
            )
        return
    store.read_manifest(folder)  # raises where the folder is not a campaign's
    if not spec.overwrite:
        _check_replaceable(spec, settings, store.resume(folder))
    shutil.rmtree(folder)


def _check_replaceable(spec: Spec, settings: Mapping[str, object], kept: store.Store) -> None:
    """Raise ValueError if a campaign has runs, unless it is the same, finished, and --again."""
    out, done, whole = spec.out, kept.done(), kept.runs or 0
    if not done:
        return
    if missing(kept.spans(), whole, max(whole, 1)):
        raise ValueError(
            f"--out: {out} holds an unfinished campaign, with {done} of {whole} runs done: "
            f"--resume {out} continues it, --overwrite replaces it; or choose another folder"
        )
    if different := differences(_flat(kept.settings), _flat(settings)):
        raise ValueError(
            f"--out: {out} holds another campaign: {different}: choose another folder, or add "
            "--overwrite to replace it"
        )
    if not spec.again or whole != spec.campaign.runs:
        raise ValueError(
            f"--out: {out} holds a finished campaign of {done} runs: --resume {out} prints it, "
            "or extends it to more --runs, --overwrite replaces it; or choose another folder"
        )
