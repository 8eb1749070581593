"""The manifest of a campaign's folder: settings, identity, digest, and the number of runs."""

import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path

from jaxslam.results.campaign_folder.block_file import (
    canonical_json,
    write_atomically,
)
from jaxslam.results.files import Json

FORMAT = 3
"""Format of the folder, written in its manifest; others are refused."""

MANIFEST = "manifest.json"
"""File with the format, the settings, the identity, their digest, and the number of runs."""

_DIGEST = re.compile("[0-9a-f]{16}")
"""Digest of a part of an identity; its digits tell a user nothing."""


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
    own = {"settings": settings, "campaign": campaign}
    manifest = {"format": FORMAT, "digest": digest_of(own), "runs": runs, **own}
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
    there: Mapping[str, object], here: Mapping[str, object], above: str = ""
) -> list[str]:
    """A sentence for each setting that differs, in nested settings, too."""
    found = []
    for key in {**there, **here}:
        values = [side[key] for side in (there, here) if key in side]
        inner = [value for value in values if isinstance(value, dict)]
        if len(inner) == 2:
            found += differences_of(inner[0], inner[1], f"{above}{key}.")
        elif len(values) < 2 or canonical_json(values[0]) != canonical_json(values[1]):
            plain = all(isinstance(value, str) for value in values)
            old, new = (
                (str(side[key]) if plain else json.dumps(side[key], ensure_ascii=False))
                if key in side
                else "absent"
                for side in (there, here)
            )
            if (
                len(values) == 2
                and plain
                and all(_DIGEST.fullmatch(str(value)) for value in values)
            ):
                how = "has other numbers or other code than in the stored runs"
            else:
                how = f"{old} there, {new} here"
            found.append(f"{above}{key}: {how}")
    return found
