"""A campaign's compiled programs in the cache folder, found by name and without a trace.

JAX's own cache identifies a program by its text, so a program must be traced and lowered before it
can be found. The command identifies it by the names of scenario and filter and a digest of the
package's source.
"""

import contextlib
import hashlib
import importlib.resources
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

import jax

from jaxslam.cli.runtime import cache
from jaxslam.results.files import versions

PACKAGE = Path(str(importlib.resources.files("jaxslam")))
"""The folder of the package, whose source decides what a program computes."""

_NOT_OF_A_PROGRAM = frozenset({"seed", "filters", "bound"})
"""Entries of an identity that a single program does not depend on."""


def identity(asked: Mapping[str, object], platform: str) -> dict[str, str]:
    """The identity of a campaign: its options, versions, platform and a digest of the source.

    Args:
        asked: the options of the command; the number of runs does not count.
        platform: that of the devices that compute.
    """
    options = {name: str(value) for name, value in asked.items() if name != "runs"}
    return options | versions() | {"platform": platform, "source": _source_digest()}


def _source_digest() -> str:
    """A digest of every source file of the package."""
    total = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*.py")):
        total.update(f"{path.relative_to(PACKAGE).as_posix()}\n".encode())
        total.update(path.read_bytes().replace(b"\r\n", b"\n"))
    return total.hexdigest()[:16]


class ProgramFolder:
    """A `monte_carlo.Library` in JAX's cache folder; damaged files are deleted, never used."""

    def __init__(self, folder: Path, campaign: Mapping[str, str]) -> None:
        self._folder = folder
        own = {name: value for name, value in campaign.items() if name not in _NOT_OF_A_PROGRAM}
        # The user may have chosen a folder that unlike machines share.
        self._identity = json.dumps(own | {"kind": cache.processor_kind()}, sort_keys=True)

    def get(self, name: str) -> bytes | None:
        """The program of that name, or None; a damaged one is deleted with a warning."""
        path = self._path(name)
        try:
            whole = path.read_bytes()
        except OSError:
            return None
        digest, content = whole[:32], whole[32:]
        if hashlib.sha256(content).digest() == digest:
            with contextlib.suppress(OSError):
                os.utime(path)  # `prune` deletes the least recently used programs
            return content
        with contextlib.suppress(OSError):
            path.unlink()
        cache.warn(f"a compiled program in {self._folder} is damaged; continuing without it")
        return None

    def put(self, name: str, content: bytes) -> None:
        """Write a program to its file; the file appears only when it is complete."""
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
        digest = hashlib.sha256(f"{self._identity} {name}".encode()).hexdigest()
        return self._folder / f"jaxslam-{digest[:32]}-cache"


@contextlib.contextmanager
def program_folder(campaign: Mapping[str, str]) -> Iterator[ProgramFolder | None]:
    """A block with a campaign's `ProgramFolder` in place of JAX's own cache.

    It is None where the cache is off.

    Args:
        campaign: its `identity`.
    """
    folder = jax.config.jax_compilation_cache_dir
    if folder is None:
        yield None
        return
    with cache.jax_settings(jax_compilation_cache_dir=None):
        yield ProgramFolder(Path(folder), campaign)
