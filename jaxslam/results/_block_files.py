"""The files of a store of runs: blocks and the manifest, each written completely or not at all."""

import contextlib
import errno
import hashlib
import io
import json
import math
import operator
import os
import re
import secrets
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxslam.results._files import Json

FORMAT = 4
"""Format of the folder, written in its manifest; others are refused."""

MANIFEST = "manifest.json"
"""File with the format, the settings, the identity, their digest, and the number of runs."""

_DIGEST = re.compile("[0-9a-f]{16}")
"""Digest of a part of an identity; messages leave its digits out."""

_ABOUT = "_block"
"""Entry of the npz that describes the block."""
_NAME = re.compile(r"block-(\d{8,})-(\d{8,})\.npz", re.ASCII)
_KINDS = "biufcSU"
"""Kinds of dtypes that npz keeps without pickle."""


class Block(NamedTuple):
    """The results of runs first … first + runs - 1."""

    first: int
    runs: int
    arrays: dict[str, np.ndarray]


def write_block(
    folder: Path, first: int, arrays: Mapping[str, np.ndarray], runs: int, campaign: str
) -> Path:
    """Write runs first … first + runs - 1 to a file in a folder, and return its path.

    Raises ValueError on names and dtypes that npz cannot keep, and OSError, with the path and the
    size, where the disk fails; after any error, an interrupt too, the folder is as it was before.

    Args:
        folder: the folder of the blocks.
        first: number of the first run.
        arrays: the results by name.
        runs: number of runs.
        campaign: the digest of the campaign.
    """
    first, runs = operator.index(first), operator.index(runs)
    if first < 0 or runs < 1:
        raise ValueError(f"block: expected runs >= 1 and first >= 0, got {runs} and {first}")
    entries = {name: np.asarray(array) for name, array in arrays.items()}
    for name, array in entries.items():
        if not name.isprintable() or name in ("", _ABOUT) or re.search(r"\\|\.npy$", name):
            raise ValueError(f"{name!r} cannot be the name of an array in a block")
        if array.dtype.kind not in _KINDS:
            raise ValueError(f"array {name!r}: dtype {array.dtype} cannot be kept in a block")
    about = {"first": first, "runs": runs, "settings": campaign}
    about["sha256"] = _checksum(about, entries)
    entries[_ABOUT] = np.frombuffer(canonical_json(about).encode(), np.uint8)
    path = folder / f"block-{first:08d}-{first + runs:08d}.npz"
    # As `np.savez` writes them, without pickle and without dates. `np.savez` takes names as keyword
    # arguments, and has some of its own, as `file`.
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as npz:
        for name, array in entries.items():
            with npz.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, array, allow_pickle=False)
    write_atomically(path, content.getvalue())
    return path


def read_block(path: Path, campaign: str) -> Block:
    """The block in a file; raises ValueError with the file and the reason.

    campaign: the digest of the campaign that the block must belong to.
    """
    content = path.read_bytes()
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as npz:
            # All entries are tested first: a header may ask for any amount of memory.
            if sum(entry.file_size for entry in npz.zip.infolist()) > len(content):
                raise ValueError("its entries are larger than the file")
            if broken := npz.zip.testzip():
                raise ValueError(f"entry {broken} is damaged")
            for entry in npz.zip.infolist():
                _check_size(npz.zip, entry)
            arrays = {name: np.asarray(npz[name]) for name in npz.files}
    except MemoryError:
        raise
    except Exception as error:  # NumPy and zipfile raise many types
        reason = " ".join(str(error).split())
        raise ValueError(f"{path}: truncated or not an npz ({reason})") from error
    try:
        about = json.loads(arrays.pop(_ABOUT).tobytes())
        first, runs, checksum = about["first"], about["runs"], about.pop("sha256")
        settings, computed = about["settings"], _checksum(about, arrays)
    except (KeyError, TypeError, AttributeError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: an npz, but not a block of a campaign") from error
    if checksum != computed:
        raise ValueError(f"{path}: its content does not match its checksum")
    if settings != campaign:
        raise ValueError(f"{path}: belongs to another campaign, or to other settings")
    if (named := runs_of_name(path)) != (first, first + runs):
        names = f"names runs {named[0]} to {named[1]}" if named else "names no runs"
        raise ValueError(f"{path}: {names}, holds {first} to {first + runs}")
    return Block(first, runs, arrays)


def _check_size(npz: zipfile.ZipFile, entry: zipfile.ZipInfo) -> None:
    """Raise an error on an entry whose header announces more than it holds."""
    with npz.open(entry) as file:
        version = np.lib.format.read_magic(file)
        shape, _, dtype = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version](file)
    if math.prod(shape) * dtype.itemsize > entry.file_size:
        raise ValueError(f"entry {entry.filename} is damaged")


def runs_of_name(path: Path) -> tuple[int, int] | None:
    """(first run, one past the last) by the name of a file; None if it is no name of a block."""
    match = _NAME.fullmatch(path.name)
    return (int(match[1]), int(match[2])) if match else None


def block_order(path: Path) -> tuple[int, int, str]:
    """Sorting key of block files: by the first run, longer blocks first."""
    first, end = runs_of_name(path) or (-1, 0)
    return first, -end, path.name


def write_atomically(path: Path, content: bytes, new: bool = False) -> None:
    """Write a file completely or not at all, through a hidden file of this process beside it.

    new: raise FileExistsError where the path exists. Of several processes one then writes it; on a
    file system without hard links, of those that do not begin within microseconds.
    """
    hidden = path.with_name(f".{path.name}-{os.getpid()}-{secrets.token_hex(4)}.tmp")
    try:
        with hidden.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if new:
            _link(hidden, path)
        else:
            os.replace(hidden, path)
    except OSError as error:
        reason = f"cannot write {len(content):,} bytes, {error.strerror or error}"
        raise OSError(error.errno, reason, str(path)) from error
    finally:
        with contextlib.suppress(OSError):
            hidden.unlink()


def is_unfinished(path: Path) -> bool:
    """Whether a file is one that a process writes, or was killed while it wrote."""
    return path.name.startswith(".") and path.name.endswith(".tmp")


def _link(hidden: Path, path: Path) -> None:
    """Give a file a second name; raises FileExistsError where there is a file of that name."""
    try:
        os.link(hidden, path)
    except FileExistsError:
        raise
    except OSError:  # the file system has no hard links
        if path.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST)) from None
        os.replace(hidden, path)


def canonical_json(value: object) -> str:
    """JSON with sorted keys, the same for equal values; raises ValueError on NaN and infinity."""
    return json.dumps(value, sort_keys=True, allow_nan=False)


def _checksum(about: Mapping[str, object], arrays: Mapping[str, np.ndarray]) -> str:
    """SHA-256 of the description and of the names, dtypes, shapes and bytes of the arrays."""
    total = hashlib.sha256(canonical_json(about).encode())
    for name, array in sorted(arrays.items()):
        total.update(canonical_json([name, array.dtype.str, array.shape]).encode())
        total.update(array.tobytes())
    return total.hexdigest()


def read_manifest(folder: Path) -> Json:
    """The content of the manifest of a campaign's folder, in any format.

    Raises ValueError if there is none, or if the file is no manifest.
    """
    path = folder / MANIFEST
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ValueError(
            f"no campaign to resume: there is no {path}: give the folder of an interrupted "
            "campaign, or begin a new one"
        ) from error
    except json.JSONDecodeError as error:
        raise ValueError(f"{path}, line {error.lineno}: {error.msg}") from error
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not JSON ({error})") from error
    if not isinstance(manifest, dict) or "format" not in manifest:
        raise ValueError(f"{path}: not the manifest of a campaign")
    return manifest


def write_manifest(
    folder: Path,
    settings: Mapping[str, object],
    campaign: Mapping[str, str],
    runs: int | None,
    new: bool = False,
) -> None:
    """Write the manifest of a folder; new: raises FileExistsError where there is one."""
    content = {"settings": settings, "campaign": campaign}
    manifest = {"format": FORMAT, "digest": digest_of(content), "runs": runs, **content}
    text = json.dumps(manifest, indent=2, ensure_ascii=False) + "\n"
    write_atomically(folder / MANIFEST, text.encode(), new)


def as_stored(settings: Mapping[str, object]) -> Json:
    """Settings as the manifest returns them: tuples become lists, keys strings."""
    plain: Json = json.loads(json.dumps(dict(settings), allow_nan=False))
    return plain


def digest_of(settings: Mapping[str, object]) -> str:
    """SHA-256 of settings."""
    return hashlib.sha256(canonical_json(settings).encode()).hexdigest()


def differences_of(
    stored: Mapping[str, object], current: Mapping[str, object], prefix: str = ""
) -> list[str]:
    """A sentence for each setting that differs, in nested settings, too.

    prefix: the keys above these settings.
    """
    sentences = []
    for key in {**stored, **current}:
        values = [side[key] for side in (stored, current) if key in side]
        nested = [value for value in values if isinstance(value, dict)]
        if len(nested) == 2:
            sentences += differences_of(nested[0], nested[1], f"{prefix}{key}.")
        elif len(values) < 2 or canonical_json(values[0]) != canonical_json(values[1]):
            are_texts = all(isinstance(value, str) for value in values)
            are_digests = are_texts and all(_DIGEST.fullmatch(str(value)) for value in values)
            old, new = (
                "absent"
                if key not in side
                else "present"
                if are_digests
                else str(side[key])
                if are_texts
                else json.dumps(side[key], ensure_ascii=False)
                for side in (stored, current)
            )
            if len(values) == 2 and are_digests:
                difference = "has other numbers or other code than in the stored runs"
            else:
                difference = f"{old} there, {new} here"
            sentences.append(f"{prefix}{key}: {difference}")
    return sentences


def is_original(manifest: Json) -> bool:
    """Whether settings and campaign of a manifest have its digest."""
    content = {key: manifest.get(key) for key in ("settings", "campaign")}
    try:
        return manifest.get("digest") == digest_of(content)
    except ValueError:  # a number that JSON does not have
        return False
