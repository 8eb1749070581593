"""A campaign's compiled programs in the cache folder, by the names that the command was given.

JAX's own cache is asked with a program's text, for which it has to be traced and lowered first. The
command knows what it runs without that: scenario and filters by name, of this source.
"""

import contextlib
import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax

from jaxslam.cli import cache
from jaxslam.results import report


def identity(asked: Mapping[str, Any], platform: str) -> dict[str, str]:
    """What a campaign is, by what was asked for and the source that the names in it stand for.

    The number of runs is no part of it. platform: of the devices that compute.
    """
    known = {name: str(value) for name, value in asked.items() if name != "runs"}
    return known | report.versions() | {"platform": platform, "source": _source()}


def _source() -> str:
    """A digest of every source file of the package."""
    total, package = hashlib.sha256(), Path(report.__file__).parent
    for path in sorted(package.rglob("*.py")):
        total.update(f"{path.relative_to(package).as_posix()}\n".encode())
        total.update(path.read_bytes().replace(b"\r\n", b"\n"))
    return total.hexdigest()[:16]


_NO_PROGRAM = frozenset({"seed", "filters", "bound"})
"""Of an identity, what is no part of a single program."""


class Programs:
    """A `monte_carlo.Library` in JAX's cache folder: what is there is whole, or is not used."""

    def __init__(self, folder: Path, known: Mapping[str, str]) -> None:
        self._folder = folder
        told = {name: value for name, value in known.items() if name not in _NO_PROGRAM}
        # The folder may be one that JAX was told of, shared by unlike machines.
        self._known = json.dumps(told | {"kind": cache.kind()}, sort_keys=True)

    def get(self, name: str) -> bytes | None:
        """The program of that name, or None; a damaged one is deleted, and said."""
        path = self._path(name)
        try:
            whole = path.read_bytes()
        except OSError:
            return None
        digest, content = whole[:32], whole[32:]
        if hashlib.sha256(content).digest() == digest:
            with contextlib.suppress(OSError):
                os.utime(path)  # what was not used for longest is deleted first
            return content
        with contextlib.suppress(OSError):
            path.unlink()
        cache.warn(f"a compiled program in {self._folder} is damaged; going on without it")
        return None

    def put(self, name: str, content: bytes) -> None:
        """Keep it, whole or not at all."""
        path = self._path(name)
        hidden = path.with_name(f".{path.name}-{os.getpid()}")
        try:
            hidden.write_bytes(hashlib.sha256(content).digest() + content)
            os.replace(hidden, path)
        except OSError as error:
            reason = error.strerror or error
            cache.warn(f"a compiled program cannot be kept in {self._folder} ({reason})")
        finally:
            with contextlib.suppress(OSError):
                hidden.unlink()

    def _path(self, name: str) -> Path:
        digest = hashlib.sha256(f"{self._known} {name}".encode()).hexdigest()
        return self._folder / f"jaxslam-{digest[:32]}-cache"


@contextlib.contextmanager
def of_this_command(known: Mapping[str, str]) -> Iterator[Programs | None]:
    """The programs that are kept for it, instead of JAX's own cache; None where none are to be
    kept, or several processes share the work."""
    folder = jax.config.jax_compilation_cache_dir
    if folder is None or jax.process_count() > 1:
        yield None
        return
    with cache.settings(jax_compilation_cache_dir=None):
        yield Programs(Path(folder), known)
