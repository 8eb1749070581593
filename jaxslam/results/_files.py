"""Files of results: JSON and CSV as text, and writing of all files or none."""

import contextlib
import json
import math
import os
import platform
import tempfile
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import SupportsFloat, TypeAlias

Json: TypeAlias = dict[str, object]
"""An object of JSON."""

Content: TypeAlias = str | bytes | Callable[[Path], object]
"""The content of a file: text, bytes, or a function that writes it to a path."""

Files: TypeAlias = dict[str, Content]
"""Contents by file name, for `write_files`."""


def json_text(content: Mapping[str, object]) -> str:
    """Indented JSON; raises ValueError on NaN and infinity, which JSON does not have."""
    return json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def json_number(value: SupportsFloat) -> float | None:
    """The number, or None (null) if it is not finite, which JSON does not have."""
    number = float(value)
    return number if math.isfinite(number) else None


def versions() -> dict[str, str]:
    """The versions of Python, JAX and NumPy."""
    return {"python": platform.python_version()} | {
        name: version(name) for name in ("jax", "numpy")
    }


def check_writable(folder: Path) -> None:
    """Raise OSError, before any work, if files cannot be written to a folder.

    The folder is not created; its nearest existing parent is tried.
    """
    try:
        existing = folder.absolute()
        while not existing.exists():
            existing = existing.parent
        if not existing.is_dir():
            raise NotADirectoryError(f"{existing} is not a folder")
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        reason = error.strerror or str(error)
        raise type(error)(f"results cannot be written to {folder}: {reason}") from error


def write_files(
    folder: Path,
    files: Mapping[str, Content],
    *,
    replaces: Sequence[str] = (),
) -> list[Path]:
    """Write all files or, after any error or interrupt, none; returns their paths.

    The files are written to a hidden folder in the target and moved into place when all are
    complete. After an error, folders that were created for them are removed.

    Args:
        folder: the target, which is created if needed.
        files: contents by name.
        replaces: patterns of names of earlier results; matching files that are not written now
            are deleted at the end.
    """
    created = [path for path in (folder, *folder.parents) if not path.exists()]
    for name in files:
        if (folder / name).is_dir():
            raise IsADirectoryError(f"{folder / name} cannot be written: it is a folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".unfinished-") as hidden:
            for name, content in files.items():
                target = Path(hidden) / name
                if callable(content):
                    content(target)
                elif isinstance(content, bytes):
                    target.write_bytes(content)
                else:
                    target.write_text(content, encoding="utf-8")
            for name in files:
                os.replace(Path(hidden) / name, folder / name)
    except BaseException:
        for path in created:
            with contextlib.suppress(OSError):  # not empty, or never created
                path.rmdir()
        raise
    for pattern in replaces:
        for old in folder.glob(pattern):
            if old.name not in files:
                old.unlink()
    return [folder / name for name in files]
