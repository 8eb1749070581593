"""The worlds of a campaign for estimators of any kind: as arrays, and as folders of tables."""

import contextlib
import hashlib
import json
import os
import platform
import re
import secrets
import shutil
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.consistency._digests import digest, identity
from jaxslam.consistency._draw_readme import readme_text
from jaxslam.consistency._draw_tables import (
    Files,
    check_tables,
    odometry_of,
    run_files,
    truth_files,
)
from jaxslam.core.types import Log, Truth
from jaxslam.core.validation import (
    instance_of,
    prng_key,
    refusals_of,
    require,
)
from jaxslam.simulation._worlds import BLOCK, World, draw_block, run_count

RECORD = "draws.json"
"""File with key, world, options, versions and checksums of a folder of draws."""

FORMAT = 1
"""Format of the folder, in `RECORD`; others are refused."""

_NOT_OF_DRAWS = ("source", "dtype", "bound", "filters")
"""Parts of the identity of a campaign that do not concern its draws."""

_DIGEST = re.compile("[0-9a-f]{16}")
"""Digest of a part of an identity, which messages leave out."""

_UNFINISHED = ".unfinished-"
"""Prefix of hidden folders, in which a run is written before it is moved."""


def draws(world: World, runs: int, key: jax.Array) -> Iterator[tuple[Truth, Log]]:
    """The truth and the log of each run of a campaign, in NumPy: run i has key fold_in(key, i).

    They are the worlds that `monte_carlo(world, …, runs, key)` draws, in the dtype JAX is set to.
    They are drawn in blocks as they are needed, so the number of runs takes no memory.

    Raises ValueError on another world, runs below 1, more runs than are recorded, and no PRNG key.
    """
    with refusals_of("draws"):
        _check(world, runs, key)
    return (history for _, history in _histories(world, range(runs), key))


def write_draws(
    world: World,
    runs: int,
    key: jax.Array,
    folder: str | Path,
    *,
    options: Mapping[str, object] | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> list[Path]:
    """Write the runs of a campaign as tables, for an estimator in any language.

        folder/README.md        files, times, equations and numbers of this world
        folder/draws.json       key, world, versions, SHA-256 of each file
        folder/runs/0000/       odometry.csv, measurements.csv, dataset.toml: `datasets.table`
        folder/truth/0000/      truth.csv, the pose at each scan, and landmarks.csv

    Nothing in `runs` comes from the truth. Numbers read back exactly. Settings that dataset.toml
    cannot say, as a model of your own, are named in the README, and `datasets.table` refuses them.

    A run appears when it is complete. The same call continues an interrupted one, and one of more
    runs extends it; finished runs whose files have their checksums are not drawn again.

    Args:
        world: of one robot with one sensor, of points or of the robot itself.
        runs: the number of runs; run i has key fold_in(key, i).
        key: a PRNG key.
        folder: created if needed.
        options: kept in draws.json, as those of the command; the world by name, for instance.
        progress: called with (runs written, runs) after each run.
    Returns:
        The folders of the runs.
    Raises:
        ValueError: on a world whose logs no table holds (teams, suites of sensors, lines), as
            `draws` does, and on a folder that holds other draws, by what differs, or other files.
    """
    with refusals_of("write_draws"):
        _check(world, runs, key)
        check_tables(world)
    odometry = odometry_of(world, world.controls)
    folder = Path(folder)
    parts = identity(world, {}, key, jax.default_backend())
    # What agrees between two calls for one folder.
    campaign = {name: text for name, text in parts.items() if name not in _NOT_OF_DRAWS}
    campaign |= {"filter options": digest(world.filter_options)}
    checksums = _earlier_checksums(folder, campaign, runs)
    record = _record(world, key, runs, campaign, options)

    def write_record() -> None:
        content = record | {"checksums": dict(sorted(checksums.items()))}
        _write(folder / RECORD, json.dumps(content, indent=2, ensure_ascii=False) + "\n")

    folder.mkdir(parents=True, exist_ok=True)
    for stale in folder.glob(f"{_UNFINISHED}*"):
        shutil.rmtree(stale, ignore_errors=True)
    write_record()
    _write(folder / "README.md", readme_text(world, runs, odometry))
    names = [f"{number:04d}" for number in range(runs)]
    # Runs whose files are all there, as they were written, are not drawn again.
    present: dict[str, bool] = {}
    for file, checksum in checksums.items():
        name = file.split("/")[1]
        present[name] = present.get(name, True) and (folder / file).is_file()
        if present[name] and _sha256((folder / file).read_bytes()) != checksum:
            raise ValueError(f"{folder / file} was changed: restore it, or choose another folder")
    missing = [number for number, name in enumerate(names) if not present.get(name)]
    try:
        for count, (number, (truth, log)) in enumerate(_histories(world, missing, key), 1):
            name, run, true = names[number], run_files(world, log), truth_files(world, truth, log)
            _write_run(folder, name, run, true)
            for kind, files in (("runs", run), ("truth", true)):
                checksums |= {f"{kind}/{name}/{f}": _sha256(s.encode()) for f, s in files.items()}
            if count % BLOCK == 0:
                write_record()
            if progress is not None:
                progress(runs - len(missing) + count, runs)
    finally:
        write_record()
    return [folder / "runs" / name for name in names]


def _check(world: World, runs: int, key: jax.Array) -> None:
    require("world", world, instance_of(World))
    require("runs", runs, run_count(world))
    require("key", key, prng_key)


def _histories(
    world: World, numbers: Collection[int], key: jax.Array
) -> Iterator[tuple[int, tuple[Truth, Log]]]:
    """The runs of these numbers, which rise, with their numbers."""
    block: tuple[Truth, Log] | None = None
    first = -1
    for number in numbers:
        if block is None or number - number % BLOCK != first:
            first = number - number % BLOCK
            block = draw_block(world, key, first)
        place = number - first
        yield number, jax.tree.map(lambda leaf, i=place: leaf[i], block)


def _record(
    world: World,
    key: jax.Array,
    runs: int,
    campaign: Mapping[str, str],
    options: Mapping[str, object] | None,
) -> dict[str, object]:
    """The content of draws.json without checksums."""
    typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    numbers = np.asarray(jax.random.key_data(key) if typed else key)
    kind = str(jax.random.key_impl(key)) if typed else "raw"
    return {
        "format": FORMAT,
        "scenario": world.name,
        "steps": world.steps,
        "runs": runs,
        "key": {"kind": kind, "numbers": numbers.tolist()},
        "dtype": str(jnp.result_type(float)),
        "options": dict(options or {}),
        "versions": {
            "python": platform.python_version(),
            "numpy": np.__version__,
            **{name: campaign[name] for name in ("jaxslam", "jax", "jaxlib")},
        },
        "campaign": dict(campaign),
    }


def _earlier_checksums(folder: Path, campaign: Mapping[str, str], runs: int) -> dict[str, str]:
    """The checksums of the files of an earlier call; ValueError on other draws or other files."""
    path = folder / RECORD
    if not path.exists():
        if folder.is_dir() and not all(file.name.startswith(".") for file in folder.iterdir()):
            raise ValueError(f"{folder} holds files that are no draws: choose another folder")
        return {}
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        stored, checksums, count = record["campaign"], record["checksums"], int(record["runs"])
        form, usable = record["format"], isinstance(stored, dict) and isinstance(checksums, dict)
    except (ValueError, LookupError, TypeError) as error:
        raise ValueError(f"{path}: is no record of draws: choose another folder") from error
    if form != FORMAT or not usable:
        raise ValueError(f"{path}: expected format {FORMAT}, got {form!r}: choose another folder")
    differences = [
        f"another {name}"
        if _DIGEST.fullmatch(text)
        else f"{name} is {stored.get(name)} there, {text} here"
        for name, text in campaign.items()
        if stored.get(name) != text
    ]
    if differences:
        raise ValueError(
            f"{folder} holds other draws: {'; '.join(differences)}: choose another folder"
        )
    if runs < count:
        raise ValueError(f"{folder} holds {count} runs: expected at least as many, got {runs}")
    return {str(name): str(value) for name, value in checksums.items()}


def _write_run(folder: Path, name: str, run: Files, truth: Files) -> None:
    """Write the folders of a run, each of which appears when it is complete."""
    with tempfile.TemporaryDirectory(dir=folder, prefix=_UNFINISHED) as hidden:
        for kind, files in (("truth", truth), ("runs", run)):
            complete, target = Path(hidden) / kind, folder / kind / name
            complete.mkdir()
            for file, text in files.items():
                (complete / file).write_text(text, encoding="utf-8", newline="\n")
            target.parent.mkdir(exist_ok=True)
            if target.exists():  # of a call that was killed before it noted the run
                shutil.rmtree(target)
            os.replace(complete, target)


def _write(path: Path, text: str) -> None:
    """Write a file completely or not at all."""
    hidden = path.with_name(f".{path.name}-{secrets.token_hex(4)}.tmp")
    try:
        hidden.write_text(text, encoding="utf-8", newline="\n")
        os.replace(hidden, path)
    finally:
        with contextlib.suppress(OSError):
            hidden.unlink()


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
