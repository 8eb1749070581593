"""A block of a campaign's runs as an npz file: written completely or not at all, with a checksum.

The file holds the arrays and an entry that gives the numbers of its runs, the digest of the
campaign they belong to, and the checksum over all of that.
"""

import contextlib
import errno
import hashlib
import io
import json
import operator
import os
import re
import secrets
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

_ABOUT = "_block"  # the entry of the npz that describes the block
_NAME = re.compile(r"block-(\d{8,})-(\d{8,})\.npz", re.ASCII)
_KINDS = "biufcSU"  # of dtypes that npz keeps without pickle


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
        folder, first, arrays, runs: what to write, and where.
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
    write_atomically(path, _npz(entries))
    return path


def read_block(path: Path, campaign: str) -> Block:
    """The block in a file; raises ValueError with the file and what is wrong with it.

    campaign: the digest of the campaign that the block must belong to.
    """
    content = path.read_bytes()
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as npz:
            # All entries are tested first: a damaged header may ask for any amount of memory.
            if broken := npz.zip.testzip():
                raise ValueError(f"entry {broken} is damaged")
            arrays = {name: np.asarray(npz[name]) for name in npz.files}
    except MemoryError:
        raise
    except Exception as error:  # NumPy and zipfile raise many types
        raise ValueError(f"{path}: truncated or not an npz ({error})") from error
    try:
        about = json.loads(arrays.pop(_ABOUT).tobytes())
        first, runs, checksum = about["first"], about["runs"], about.pop("sha256")
        settings = about["settings"]
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"{path}: an npz, but not a block of a campaign") from error
    if checksum != _checksum(about, arrays):
        raise ValueError(f"{path}: its content does not match its checksum")
    if settings != campaign:
        raise ValueError(f"{path}: belongs to another campaign, or to other settings")
    if (named := runs_of_name(path)) != (first, first + runs):
        names = f"names runs {named[0]} to {named[1]}" if named else "names no runs"
        raise ValueError(f"{path}: {names}, holds {first} to {first + runs}")
    return Block(first, runs, arrays)


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
        with open(hidden, "wb") as file:
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


def _npz(arrays: Mapping[str, np.ndarray]) -> bytes:
    """The bytes that `np.savez` writes, for any names, without pickle and without dates."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as npz:
        for name, array in arrays.items():
            with npz.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, array, allow_pickle=False)
    return out.getvalue()


def _checksum(about: Mapping[str, object], arrays: Mapping[str, np.ndarray]) -> str:
    """SHA-256 of the description and of the names, dtypes, shapes and bytes of the arrays."""
    total = hashlib.sha256(canonical_json(about).encode())
    for name, array in sorted(arrays.items()):
        total.update(canonical_json([name, array.dtype.str, array.shape]).encode())
        total.update(array.tobytes())
    return total.hexdigest()
