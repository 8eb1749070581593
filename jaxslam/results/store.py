"""The folder of a campaign's finished blocks of runs, from which a campaign can be resumed.

A block is an npz file that appears only when it is complete, so an interrupted program loses no
block but the current one. A file that is damaged or belongs to another campaign is renamed and not
counted. A manifest holds the caller's settings and the identity of the campaign.
"""

import contextlib
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from jaxslam.consistency.campaign._pieces import missing_pieces
from jaxslam.results._block_files import (
    FORMAT,
    MANIFEST,
    Block,
    as_stored,
    block_order,
    differences_of,
    digest_of,
    is_original,
    read_block,
    read_manifest,
    runs_of_name,
    write_block,
    write_manifest,
)

__all__ = ["Store", "open", "resume"]


@dataclass(frozen=True)
class Store:
    """Finished blocks of a campaign in a folder; make one with `open` or `resume`.

    Several processes may save into one folder. Killed processes leave hidden files `.block-….tmp`,
    which are never read.
    """

    folder: Path
    settings: Mapping[str, object]
    runs: int | None = None
    """number of runs that the campaign is to have, if known; it may be extended"""
    campaign: dict[str, str] = field(default_factory=dict)
    """the identity of the campaign that claimed the folder; empty until one does"""
    set_aside: list[str] = field(default_factory=list)
    """a sentence on each bad file that `blocks` renamed"""

    def claim(self, identity: Mapping[str, str]) -> None:
        """Note in a new folder the campaign it belongs to; check it in any other folder.

        The number of runs is noted, too, which may extend the campaign. Raises ValueError that
        names every difference of identities, as "key: … there, … here", and what to do then.
        """
        campaign = {str(name): str(value) for name, value in identity.items()}
        if not (self.folder / MANIFEST).exists():
            with contextlib.suppress(FileExistsError):
                write_manifest(self.folder, self.settings, campaign, self.runs, new=True)
        stored = resume(self.folder, self.settings)  # another process may have claimed it since
        if stored.campaign and (differences := differences_of(stored.campaign, campaign)):
            raise ValueError(
                f"{self.folder} holds another campaign: {'; '.join(differences)}; choose another "
                "folder, or replace its runs (in the command, --overwrite)"
            )
        runs = stored.runs if self.runs is None else self.runs
        if not stored.campaign or runs != stored.runs:
            write_manifest(self.folder, stored.settings, campaign, runs)
        self.campaign.clear()
        self.campaign.update(campaign)

    def save(self, first: int, arrays: Mapping[str, np.ndarray], runs: int) -> Path:
        """Write runs first … first + runs - 1 to a file and return its path; see `write_block`."""
        return write_block(self.folder, first, arrays, runs, self._digest())

    def load(self, path: Path) -> Block:
        """The block in a file; raises ValueError with the file and the reason."""
        return read_block(path, self._digest())

    def spans(self) -> list[tuple[int, int]]:
        """The runs (first, runs) of each block by its name; only `blocks` reads the files."""
        ranges = (runs_of_name(path) for path in self.folder.glob("block-*.npz"))
        return sorted((first, end - first) for first, end in filter(None, ranges))

    def done(self) -> int:
        """Number of finished runs, by the names of the blocks."""
        spans = self.spans()
        end = max((first + runs for first, runs in spans), default=0)
        return end - sum(count for _, count in missing_pieces(spans, end, max(end, 1)))

    def blocks(self) -> Iterator[Block]:
        """The valid blocks in order of their runs, read one at a time; no run occurs twice.

        Of two blocks that share a run the one that starts first is taken; of two that start
        together, the longer. Any other file is renamed to NAME.bad and noted in `set_aside`.
        """
        end = 0
        for path in sorted(self.folder.glob("block-*.npz"), key=block_order):
            named = runs_of_name(path)
            try:
                if named and named[0] < end:
                    raise ValueError(
                        f"{path}: repeats runs of the block before it, which ends at {end}"
                    )
                block = self.load(path)
            except FileNotFoundError:
                continue  # another process has renamed it
            except ValueError as error:
                self._put_aside(path, error)
                continue
            end = block.first + block.runs
            yield block
            del block  # to free memory before the next is read

    def _digest(self) -> str:
        """The digest that ties blocks to this campaign and its settings."""
        return digest_of({"settings": self.settings, "campaign": self.campaign})

    def _put_aside(self, path: Path, reason: ValueError) -> None:
        """Rename a bad file, and note why."""
        name, number = f"{path.name}.bad", 1
        while (path.parent / name).exists():
            name, number = f"{path.name}.bad{number}", number + 1
        with contextlib.suppress(FileNotFoundError):
            path.rename(path.parent / name)
        self.set_aside.append(f"{reason}; not used, renamed to {name}")


def open(
    folder: str | os.PathLike[str],
    settings: Mapping[str, object] | None = None,
    runs: int | None = None,
) -> Store:
    """The store of the campaign in a folder, or of a new campaign if the folder holds none.

    `monte_carlo(keep=…)` notes the identity of the campaign in it, and refuses another one.
    Independent processes may open one folder, and compute a part of the campaign each.

    Args:
        folder: the folder, which is created if needed.
        settings: further settings that must agree when the campaign is opened again, of JSON's
            types.
        runs: number of runs that the campaign is to have; a larger number than before extends it
            from the next `claim` on.
    Raises:
        ValueError: where the campaign is to have more runs, and as `resume` on what is there.
    """
    folder, plain = _folder(folder), as_stored(settings or {})
    if not (folder / MANIFEST).exists():
        folder.mkdir(parents=True, exist_ok=True)
        return Store(folder, plain, runs)
    kept = resume(folder, plain)
    if runs is not None and runs < (kept.runs or 0):
        raise ValueError(
            f"{folder}: the campaign is to have {kept.runs} runs: expected at least as many, got "
            f"{runs}"
        )
    return kept if runs is None else replace(kept, runs=runs)


def resume(folder: str | os.PathLike[str], settings: Mapping[str, object] | None = None) -> Store:
    """The store of the campaign that a folder holds.

    Args:
        folder: the folder.
        settings: if given, they must equal those of the manifest.
    Raises:
        ValueError: if there is no campaign, if its manifest cannot be read, and on any difference
            of settings, naming all.
    """
    folder = _folder(folder)
    manifest, path = read_manifest(folder), folder / MANIFEST
    if manifest["format"] != FORMAT:
        raise ValueError(
            f"{path}: expected format {FORMAT}, got {manifest['format']}: begin a new campaign"
        )
    kept, campaign, runs = (manifest.get(key) for key in ("settings", "campaign", "runs"))
    if (
        not isinstance(kept, dict)
        or not isinstance(campaign, dict)
        or not isinstance(runs, int | None)
        or not is_original(manifest)
    ):
        raise ValueError(
            f"{path}: it was changed since the campaign began: put the original back, or begin a "
            "new campaign in another folder"
        )
    if settings is not None and (differences := differences_of(kept, as_stored(settings))):
        raise ValueError(f"{folder} holds another campaign: {'; '.join(differences)}")
    return Store(folder, kept, runs, campaign)


def _folder(folder: str | os.PathLike[str]) -> Path:
    """A folder as a path; raises ValueError on another type."""
    try:
        return Path(folder)
    except TypeError:
        raise ValueError(
            f"store: expected a folder, as a path or a string, got {folder!r}"
        ) from None
