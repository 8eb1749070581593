"""A campaign's finished blocks of runs in a folder: what is there is whole, and is this campaign's.

A block is one npz file that appears under its name only when all of it is on the disk, so whatever
ends the program costs the block at work and no other. Each file carries a checksum over its arrays,
the numbers of its runs, the campaign's fingerprint and the caller's settings; one that fails it is
put aside, never counted.
"""

import contextlib
import hashlib
import io
import json
import operator
import os
import re
import secrets
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxslam.monte_carlo.pieces import missing

FORMAT = 2
"""Of the folder, as its manifest says; another number is refused."""

MANIFEST = "manifest.json"
"""The file that makes a folder a campaign's: the format, settings and fingerprint, their digest,
and how many runs were asked for."""

_ABOUT = "_block"  # the entry of an npz that says which runs it holds, of what, with the checksum
_NAME = re.compile(r"block-(\d{8,})-(\d{8,})\.npz", re.ASCII)
_KINDS = "biufcSU"  # of dtypes that npz keeps as they are, without pickle


class Block(NamedTuple):
    """Runs first … first + runs - 1, and what came out of them."""

    first: int
    runs: int
    arrays: dict[str, np.ndarray]


@dataclass(frozen=True)
class Store:
    """Finished blocks of a campaign in a folder; make one with `create` or `resume`.

    Several processes may save into one folder. `set_aside` has a sentence on each file that
    `blocks` found bad and renamed. Hidden files `.block-….tmp` are what killed processes left;
    nothing reads them.
    """

    folder: Path
    settings: dict[str, Any]
    runs: int | None = None
    """how many the campaign is to have, where that was said; it may be extended"""
    campaign: dict[str, str] = field(default_factory=dict)
    """the fingerprint of the campaign that claimed the folder; empty until one does"""
    set_aside: list[str] = field(default_factory=list)

    def claim(self, fingerprint: Mapping[str, str]) -> None:
        """Say whose runs these are: a new folder notes it, any other must hold that campaign.

        The number of runs is noted with it, which extends a campaign. Raises ValueError that names
        every difference, as "key: … there, … here".
        """
        mine = {str(name): str(value) for name, value in fingerprint.items()}
        there = resume(self.folder)  # another process may have claimed it meanwhile
        if there.campaign and (differences := _differences(there.campaign, mine)):
            raise ValueError(f"{self.folder} holds another campaign: {'; '.join(differences)}")
        runs = there.runs if self.runs is None else self.runs
        if not there.campaign or runs != there.runs:
            _write_manifest(self.folder, there.settings, mine, runs)
        self.campaign.clear()
        self.campaign.update(mine)

    def save(self, first: int, arrays: Mapping[str, np.ndarray], runs: int) -> Path:
        """Write runs first … first + runs - 1 to a file of their own and return its path.

        Raises ValueError on what npz cannot keep as it is, and OSError, with the path and the size,
        where the disk fails; after any error, an interrupt too, the folder is as it was before.
        """
        first, runs = operator.index(first), operator.index(runs)
        if first < 0 or runs < 1:
            raise ValueError(f"a block of {runs} runs from run {first}: expected >= 1 and >= 0")
        whole = {name: np.asarray(array) for name, array in arrays.items()}
        for name, array in whole.items():
            if not name.isprintable() or name in ("", _ABOUT) or re.search(r"\\|\.npy$", name):
                raise ValueError(f"{name!r} cannot be the name of an array in a block")
            if array.dtype.kind not in _KINDS:
                raise ValueError(f"array {name!r}: dtype {array.dtype} cannot be kept in a block")
        about = {"first": first, "runs": runs, "settings": self._digest()}
        about["sha256"] = _checksum(about, whole)
        whole[_ABOUT] = np.frombuffer(_text(about).encode(), np.uint8)
        path = self.folder / f"block-{first:08d}-{first + runs:08d}.npz"
        _write(path, _npz(whole))
        return path

    def load(self, path: Path) -> Block:
        """The block in a file; raises ValueError with the file and what is wrong with it."""
        content = path.read_bytes()
        try:
            with np.load(io.BytesIO(content), allow_pickle=False) as npz:
                # All of it before any of it: a header with a wrong byte may ask for any memory.
                if broken := npz.zip.testzip():
                    raise ValueError(f"entry {broken} is damaged")
                arrays = {name: np.asarray(npz[name]) for name in npz.files}
        except MemoryError:
            raise
        except Exception as error:  # of many types, none of them the disk's
            raise ValueError(f"{path}: truncated or not an npz ({error})") from error
        try:
            about = json.loads(arrays.pop(_ABOUT).tobytes())
            first, runs, checksum = about["first"], about["runs"], about.pop("sha256")
            settings = about["settings"]
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise ValueError(f"{path}: an npz, but not a block of a campaign") from error
        if checksum != _checksum(about, arrays):
            raise ValueError(f"{path}: its content does not fit its checksum")
        if settings != self._digest():
            raise ValueError(f"{path}: of another campaign, or made with other settings")
        if (named := _named(path)) != (first, first + runs):
            names = f"names runs {named[0]} to {named[1]}" if named else "names no runs"
            raise ValueError(f"{path}: {names}, holds {first} to {first + runs}")
        return Block(first, runs, arrays)

    def spans(self) -> list[tuple[int, int]]:
        """(first, runs) of each block by its name alone; `blocks` looks into them."""
        named = (_named(path) for path in self.folder.glob("block-*.npz"))
        return sorted((first, last - first) for first, last in filter(None, named))

    def done(self) -> int:
        """How many runs there are, by the names of the blocks."""
        spans = self.spans()
        end = max((first + runs for first, runs in spans), default=0)
        return end - sum(count for _, count in missing(spans, end, max(end, 1)))

    def blocks(self) -> Iterator[Block]:
        """The good blocks in order of their runs, read one at a time; no run comes twice.

        Of two blocks that share a run the one that starts first is good; of two that start
        together, the longer. A bad file is renamed to NAME.bad and goes to `set_aside`.
        """
        end = 0
        for path in sorted(self.folder.glob("block-*.npz"), key=_order):
            named = _named(path)
            try:
                if named and named[0] < end:
                    raise ValueError(
                        f"{path}: has runs of the block before it, which ends at {end}"
                    )
                block = self.load(path)
            except FileNotFoundError:
                continue  # another process has put it aside
            except ValueError as error:
                self._put_aside(path, error)
                continue
            end = block.first + block.runs
            yield block
            del block  # before the next is read

    def _digest(self) -> str:
        return _digest({"settings": self.settings, "campaign": self.campaign})

    def _put_aside(self, path: Path, reason: ValueError) -> None:
        name, number = f"{path.name}.bad", 1
        while (path.parent / name).exists():
            name, number = f"{path.name}.bad{number}", number + 1
        with contextlib.suppress(FileNotFoundError):
            path.rename(path.parent / name)
        self.set_aside.append(f"{reason}; not counted, kept as {name}")


def create(
    folder: str | os.PathLike[str],
    settings: Mapping[str, Any] | None = None,
    runs: int | None = None,
) -> Store:
    """A store for a new campaign in a folder, which is made if need be.

    `monte_carlo(keep=…)` notes in it what the campaign is; nothing need be said here.

    Args:
        folder: where.
        settings: of JSON's types; what must agree besides, for two blocks to belong together.
        runs: how many the campaign is to have, as a note for who resumes it.
    Raises:
        ValueError: if the folder holds a campaign.
    """
    folder, own = _folder(folder), _plain(settings or {})
    if (folder / MANIFEST).exists():
        raise ValueError(
            f"{folder} holds a campaign of which {Store(folder, {}).done()} runs are done: resume "
            "it, or name another folder"
        )
    folder.mkdir(parents=True, exist_ok=True)
    _write_manifest(folder, own, {}, runs)
    return Store(folder, own, runs)


def resume(
    folder: str | os.PathLike[str],
    settings: Mapping[str, Any] | None = None,
    runs: int | None = None,
) -> Store:
    """The store of the campaign that a folder holds.

    Args:
        folder: where.
        settings: where given, they must be those of the manifest.
        runs: where given, how many the campaign is to have from its next `claim` on; more than
            before extend it.
    Raises:
        ValueError: if there is no campaign, if its manifest cannot be read, if it has more runs
            than are asked for, and on any difference of settings, naming all.
    """
    folder = _folder(folder)
    manifest, path = read_manifest(folder), folder / MANIFEST
    if manifest["format"] != FORMAT:
        raise ValueError(f"{path}: of format {manifest['format']}, expected {FORMAT}")
    own, campaign = manifest.get("settings"), manifest.get("campaign")
    if (
        not isinstance(own, dict)
        or not isinstance(campaign, dict)
        or manifest.get("digest") != _digest({"settings": own, "campaign": campaign})
    ):
        raise ValueError(f"{path}: it was changed since the campaign began")
    if settings is not None and (differences := _differences(own, _plain(settings))):
        raise ValueError(f"{folder} holds another campaign: {'; '.join(differences)}")
    kept = Store(folder, own, manifest.get("runs"), campaign)
    if runs is None:
        return kept
    if (end := max((first + count for first, count in kept.spans()), default=0)) > runs:
        raise ValueError(f"{folder} has runs up to {end}: expected at least as many, got {runs}")
    return replace(kept, runs=runs)


def read_manifest(folder: Path) -> dict[str, Any]:
    """What the manifest of a campaign's folder says, of whatever format.

    Raises ValueError if there is none, or if the file is no manifest.
    """
    path = folder / MANIFEST
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ValueError(f"{path} is not there: no campaign to resume") from error
    except json.JSONDecodeError as error:
        raise ValueError(f"{path}, line {error.lineno}: {error.msg}") from error
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not JSON ({error})") from error
    if not isinstance(manifest, dict) or "format" not in manifest:
        raise ValueError(f"{path}: not the manifest of a campaign")
    return manifest


def _folder(folder: Any) -> Path:
    try:
        return Path(folder)
    except TypeError:
        raise ValueError(f"expected a folder, as a path or a string, got {folder!r}") from None


def _write_manifest(
    folder: Path, settings: Mapping[str, Any], campaign: Mapping[str, str], runs: int | None
) -> None:
    own = {"settings": settings, "campaign": campaign}
    manifest = {"format": FORMAT, "digest": _digest(own), "runs": runs, **own}
    text = json.dumps(manifest, indent=2, ensure_ascii=False) + "\n"
    _write(folder / MANIFEST, text.encode())


def _named(path: Path) -> tuple[int, int] | None:
    """(first, one past the last) run by a file's name."""
    match = _NAME.fullmatch(path.name)
    return (int(match[1]), int(match[2])) if match else None


def _order(path: Path) -> tuple[int, int, str]:
    first, end = _named(path) or (-1, 0)
    return first, -end, path.name


def _npz(arrays: Mapping[str, np.ndarray]) -> bytes:
    """What `np.savez` writes, for any names, without pickle and the same each time."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as npz:
        for name, array in arrays.items():
            with npz.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, array, allow_pickle=False)
    return out.getvalue()


def _write(path: Path, content: bytes) -> None:
    """Whole or not at all, through a hidden file beside it that no other process writes."""
    hidden = path.with_name(f".{path.name}-{os.getpid()}-{secrets.token_hex(4)}.tmp")
    try:
        with open(hidden, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(hidden, path)
    except OSError as error:
        reason = f"cannot write {len(content):,} bytes, {error.strerror or error}"
        raise OSError(error.errno, reason, str(path)) from error
    finally:
        with contextlib.suppress(OSError):
            hidden.unlink()


def _text(value: Any) -> str:
    return json.dumps(value, sort_keys=True, allow_nan=False)


def _plain(settings: Mapping[str, Any]) -> dict[str, Any]:
    """As they come back from the manifest: tuples are lists, keys are strings."""
    plain: dict[str, Any] = json.loads(json.dumps(dict(settings), allow_nan=False))
    return plain


def _digest(settings: Mapping[str, Any]) -> str:
    return hashlib.sha256(_text(settings).encode()).hexdigest()


def _checksum(about: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> str:
    total = hashlib.sha256(_text(about).encode())
    for name, array in sorted(arrays.items()):
        total.update(_text([name, array.dtype.str, array.shape]).encode())
        total.update(array.tobytes())
    return total.hexdigest()


def _differences(there: Mapping[str, Any], here: Mapping[str, Any], above: str = "") -> list[str]:
    """A sentence for each setting that is not the same, in a setting of settings too."""
    found = []
    for key in {**there, **here}:
        values = [side[key] for side in (there, here) if key in side]
        if len(values) == 2 and all(isinstance(value, dict) for value in values):
            found += _differences(values[0], values[1], f"{above}{key}.")
        elif len(values) < 2 or _text(values[0]) != _text(values[1]):
            plain = all(isinstance(value, str) for value in values)
            old, new = (
                (str(side[key]) if plain else json.dumps(side[key], ensure_ascii=False))
                if key in side
                else "absent"
                for side in (there, here)
            )
            found.append(f"{above}{key}: {old} there, {new} here")
    return found
