"""Compiled programs kept on disk from one command to the next, in a folder of bounded size.

JAX keeps each program under a digest of its text, the device and the version of the compiler. This
module sets JAX's folder and bounds its size. Any failure of the cache costs a warning of one line
and the time of compilation, never a result.
"""

import argparse
import contextlib
import hashlib
import os
import platform
import re
import sys
import tempfile
import threading
import warnings
from collections.abc import Iterator
from glob import escape
from importlib.metadata import version
from pathlib import Path
from typing import TextIO

import jax
from jax.experimental.compilation_cache.compilation_cache import reset_cache

BOUND = 1 << 29
"""Largest size of the folder after a command, 512 MiB [bytes]; the least recently used files are
deleted."""

_CACHE_WARNING = re.compile(
    r"Error (reading|writing) persistent compilation cache entry for '(.*?)': "
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add `--cache` and `--no-cache` to a command."""
    group = parser.add_mutually_exclusive_group()
    group.add_argument(
        "--cache",
        metavar="DIR",
        default=argparse.SUPPRESS,  # a formatter that adds defaults would print None
        help="folder in which compiled programs are kept for later commands "
        "(default: the user's cache folder, as ~/.cache/jaxslam)",
    )
    group.add_argument(
        "--no-cache",
        action="store_true",
        default=argparse.SUPPRESS,
        help="neither keep compiled programs nor use kept ones",
    )


def user_folder() -> Path:
    """The cache folder of this user on this system, for jaxslam.

    Raises RuntimeError if the user has no home.
    """
    home = Path.home()
    if sys.platform == "darwin":
        base = home / "Library" / "Caches"
    elif sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local")
    else:
        configured = os.environ.get("XDG_CACHE_HOME", "")
        base = Path(configured) if os.path.isabs(configured) else home / ".cache"
    return base / "jaxslam"


def from_options(options: argparse.Namespace) -> contextlib.AbstractContextManager[None]:
    """The `program_cache` for the options of a command."""
    return program_cache(getattr(options, "cache", None), getattr(options, "no_cache", False))


@contextlib.contextmanager
def program_cache(root: Path | None, off: bool = False, bound: int = BOUND) -> Iterator[None]:
    """A block in which JAX writes compiled programs to a folder and reads them from it.

    The configuration of JAX is restored at the end.

    Args:
        root: the folder; None for the one that JAX is configured with, as by the environment
            variable JAX_COMPILATION_CACHE_DIR, or else `user_folder`.
        off: keep and read no programs.
        bound: largest size of the folder after the block [bytes].
    """
    if off:
        with jax_settings(jax_compilation_cache_dir=None):
            yield
        return
    if root is None and (configured := jax.config.jax_compilation_cache_dir):
        with _one_warning(Path(configured), ours=False):
            yield
        return
    try:
        root = root or user_folder()
        folder = root / processor_kind()
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except (OSError, RuntimeError) as error:
        place = root or "the user's cache folder"
        reason = getattr(error, "strerror", None) or str(error)
        warn(f"compiled programs cannot be kept in {place} ({reason}); continuing without")
        with jax_settings(jax_compilation_cache_dir=None):
            yield
        return
    try:
        with (
            jax_settings(
                jax_compilation_cache_dir=str(folder),
                jax_persistent_cache_min_compile_time_secs=0.0,
                jax_persistent_cache_min_entry_size_bytes=-1,
            ),
            _one_warning(folder, ours=True),
        ):
            yield
    finally:
        prune(root, bound)


def prune(folder: Path, bound: int) -> None:
    """Delete the least recently used files of a cache folder until its size is within the bound."""
    files = []
    for path in folder.glob("*/*-cache"):
        with contextlib.suppress(OSError):  # another process deleted it
            state = path.stat()
            files.append((max(state.st_atime, state.st_mtime), state.st_size, path))
    total = sum(size for _, size, _ in files)
    for _, size, path in sorted(files):
        if total <= bound:
            break
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
            total -= size


def processor_kind() -> str:
    """The name of the subfolder for programs that can run on this processor.

    JAX does not distinguish processors of one architecture, though code compiled for one may be
    illegal on another that mounts the same home.
    """
    features = platform.processor()
    with contextlib.suppress(OSError), open("/proc/cpuinfo", encoding="utf-8") as file:
        features = next((line for line in file if line.startswith(("flags", "Features"))), "")
    short = hashlib.sha256(features.encode()).hexdigest()[:8]
    return f"jaxlib-{version('jaxlib')}-{platform.machine()}-{short}"


@contextlib.contextmanager
def jax_settings(**values: str | float | None) -> Iterator[None]:
    """A block with these settings of JAX, which are restored at its end."""
    before = {name: getattr(jax.config, name) for name in values}
    try:
        for name, value in values.items():
            jax.config.update(name, value)
        reset_cache()  # JAX opens its cache once, and would keep the folder of before
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
        reset_cache()


@contextlib.contextmanager
def _one_warning(folder: Path, ours: bool) -> Iterator[None]:
    """A block in which the first of JAX's warnings about its cache is printed as one line.

    ours: whether damaged programs may be deleted from the folder.
    """
    once = threading.Lock()

    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        match = _CACHE_WARNING.match(str(message))
        if match is None:
            plain(message, category, filename, lineno, file, line)
            return
        for path in folder.glob(f"{escape(match[2])}-*-cache") if ours else ():
            with contextlib.suppress(OSError):
                path.unlink()
        if once.acquire(blocking=False):
            problem = "is damaged" if match[1] == "reading" else "cannot be written"
            reason = " ".join(str(message)[match.end() :].split())[:200]
            warn(f"a compiled program in {folder} {problem} ({reason}); continuing without it")

    with warnings.catch_warnings():
        warnings.filterwarnings("always", message=_CACHE_WARNING.pattern)
        plain, warnings.showwarning = warnings.showwarning, show
        yield


def warn(sentence: str) -> None:
    """Print a warning of one line on standard error."""
    print(f"jaxslam: warning: {sentence}", file=sys.stderr)
