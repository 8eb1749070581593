"""Compiled programs on the disk: kept from one command to the next, in a folder of bounded size.

JAX keeps them, each under a digest of what was compiled, for what, and by which version. Here it is
told where, the folder is held to `BOUND` bytes, and whatever is wrong with it costs one line on the
standard error and the time of compiling, never a result.
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
from typing import Any, TextIO

import jax
from jax.experimental.compilation_cache.compilation_cache import reset_cache

BOUND = 1 << 29
"""Bytes that the folder may hold after a command; what was not used for longest goes first."""

_TROUBLE = re.compile(r"Error (reading|writing) persistent compilation cache entry for '(.*?)': ")


def add_options(parser: argparse.ArgumentParser) -> None:
    """`--cache` and `--no-cache`."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--cache",
        metavar="DIR",
        default=argparse.SUPPRESS,  # which a formatter that adds defaults does not print
        help="keep compiled programs there for the next time "
        "(default: the user's cache folder, as ~/.cache/jaxslam)",
    )
    where.add_argument(
        "--no-cache",
        action="store_true",
        default=argparse.SUPPRESS,
        help="keep no compiled programs, and use none that are kept",
    )


def user_folder() -> Path:
    """Where this system's programs keep what they can make again, of this user.

    Raises RuntimeError where the user has no home.
    """
    home = Path.home()
    if sys.platform == "darwin":
        base = home / "Library" / "Caches"
    elif sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local")
    else:
        asked = os.environ.get("XDG_CACHE_HOME", "")
        base = Path(asked) if os.path.isabs(asked) else home / ".cache"
    return base / "jaxslam"


def asked_for(options: argparse.Namespace) -> contextlib.AbstractContextManager[None]:
    """`programs`, as the options say."""
    return programs(getattr(options, "cache", None), getattr(options, "no_cache", False))


@contextlib.contextmanager
def programs(asked: Path | None, none: bool = False, bound: int = BOUND) -> Iterator[None]:
    """A block in which JAX keeps what it compiles in a folder, and takes it from there.

    Afterwards JAX is set as it was.

    Args:
        asked: the folder; None for that which JAX has been told of, as by the environment's
            JAX_COMPILATION_CACHE_DIR, and where there is none for `user_folder`.
        none: keep nothing, and take nothing.
        bound: bytes that the folder is held to.
    """
    if none:
        with settings(jax_compilation_cache_dir=None):
            yield
        return
    if asked is None and (told := jax.config.jax_compilation_cache_dir):
        with _troubles_told(Path(told), ours=False):
            yield
        return
    whole = asked
    try:
        whole = whole or user_folder()
        folder = whole / kind()
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except (OSError, RuntimeError) as error:
        where = whole or "the user's cache folder"
        warn(f"compiled programs cannot be kept in {where} ({_reason(error)}); going on without")
        with settings(jax_compilation_cache_dir=None):
            yield
        return
    try:
        with (
            settings(
                jax_compilation_cache_dir=str(folder),
                jax_persistent_cache_min_compile_time_secs=0.0,
                jax_persistent_cache_min_entry_size_bytes=-1,
            ),
            _troubles_told(folder, ours=True),
        ):
            yield
    finally:
        prune(whole, bound)


def prune(folder: Path, bound: int) -> None:
    """Delete files of a cache's folder, the one not used for longest first, down to the bound."""
    found = []
    for path in folder.glob("*/*-cache"):
        with contextlib.suppress(OSError):  # another process has deleted it
            state = path.stat()
            found.append((max(state.st_atime, state.st_mtime), state.st_size, path))
    total = sum(size for _, size, _ in found)
    for _, size, path in sorted(found):
        if total <= bound:
            break
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
            total -= size


def kind() -> str:
    """Which programs run here: JAX does not tell processors of one architecture apart, though code
    for one may be illegal on another that mounts the same home."""
    features = platform.processor()
    with contextlib.suppress(OSError), open("/proc/cpuinfo", encoding="utf-8") as file:
        features = next((line for line in file if line.startswith(("flags", "Features"))), "")
    short = hashlib.sha256(features.encode()).hexdigest()[:8]
    return f"jaxlib-{version('jaxlib')}-{platform.machine()}-{short}"


@contextlib.contextmanager
def settings(**values: Any) -> Iterator[None]:
    """JAX's configuration within a block. It opens its cache once, so it has to be told."""
    before = {name: getattr(jax.config, name) for name in values}
    try:
        for name, value in values.items():
            jax.config.update(name, value)
        reset_cache()
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
        reset_cache()


@contextlib.contextmanager
def _troubles_told(folder: Path, ours: bool) -> Iterator[None]:
    """What JAX warns of its cache becomes one line; what cannot be read, or written whole, goes
    where the folder is ours."""
    once = threading.Lock()

    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        match = _TROUBLE.match(str(message))
        if match is None:
            plain(message, category, filename, lineno, file, line)
            return
        for path in folder.glob(f"{escape(match[2])}-*-cache") if ours else ():
            with contextlib.suppress(OSError):
                path.unlink()
        if once.acquire(blocking=False):
            what = "is damaged" if match[1] == "reading" else "cannot be written"
            reason = " ".join(str(message)[match.end() :].split())[:200]
            warn(f"a compiled program in {folder} {what} ({reason}); going on without it")

    with warnings.catch_warnings():
        warnings.filterwarnings("always", message=_TROUBLE.pattern)
        plain, warnings.showwarning = warnings.showwarning, show
        yield


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)


def warn(sentence: str) -> None:
    """One line on the standard error, before going on."""
    print(f"jaxslam: warning: {sentence}", file=sys.stderr)
