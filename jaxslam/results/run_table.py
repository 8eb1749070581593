"""The runs of a campaign as a table: CSV, JSON, or the columns of a data frame."""

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from jaxslam.monte_carlo import Campaign
from jaxslam.results.files import check_writable, csv_text, write_files

FORMATS = ("csv", "json")


def columns(campaign: Campaign) -> dict[str, np.ndarray]:
    """The columns of a table with a row for each run of each filter; `Campaign.to_dataframe`."""
    numbers, filters = campaign.run_numbers, campaign.filters
    none = np.full(len(numbers), np.nan)
    names = dict.fromkeys(name for s in filters.values() for name in s.per_run)
    found: dict[str, np.ndarray] = {
        "filter": np.repeat(np.array(list(filters), object), len(numbers)),
        "run": np.tile(numbers, len(filters)),
        "finite": np.concatenate([~np.isin(numbers, s.not_finite_runs) for s in filters.values()]),
    }
    for name in names:
        found[name] = np.concatenate([s.per_run.get(name, none) for s in filters.values()])
    return found


def check_table_formats(caller: str, asked: Iterable[str]) -> tuple[str, ...]:
    """The formats, each once; raises ValueError that names another."""
    kinds = tuple(dict.fromkeys(asked))
    for kind in kinds:
        if kind not in FORMATS:
            raise ValueError(f"{caller}: expected formats of {', '.join(FORMATS)}, got {kind!r}")
    return kinds


def save_table(campaign: Campaign, path: str | Path) -> Path:
    """Write the table to a file of the format that its name ends in, whole or not at all.

    In CSV what is not finite is an empty cell, in JSON (a list a column) null.

    Raises ValueError on another format.
    """
    path = Path(path)
    (kind,) = check_table_formats("Campaign.save_runs", [path.suffix.removeprefix(".")])
    check_writable(path.parent)
    found = columns(campaign)
    if kind == "json":
        made = json.dumps({name: _plain(column) for name, column in found.items()}) + "\n"
    else:
        cells = [
            ["" if value is None else str(value) for value in _plain(column)]
            for column in found.values()
        ]
        made = csv_text(list(found), [list(row) for row in zip(*cells, strict=True)])
    return write_files(path.parent, {path.name: made})[0]


def _plain(column: np.ndarray) -> list[object]:
    """The values as Python's own, None where not finite."""
    if column.dtype.kind != "f":
        return list(column.tolist())
    return [value if np.isfinite(value) else None for value in column.tolist()]
