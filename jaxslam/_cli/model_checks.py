"""A log beside its twins, as commands check, print and write it."""

import argparse
from collections.abc import Mapping
from typing import Any

import jax

from jaxslam._cli.common import Drawings
from jaxslam.consistency import ModelCheck, check_models
from jaxslam.consistency._model_check import LEAST
from jaxslam.consistency.campaign._progress import Progress
from jaxslam.core.protocols import Candidate, Filter
from jaxslam.core.types import Log
from jaxslam.core.validation import at_least, require
from jaxslam.results._files import Files, Json, json_number, json_text
from jaxslam.simulation import Twin

CHECK = "check.json"
"""Name of the file of the checks."""

_OTHER = ("dead_reckoning", "localization", "mapping", "particle_localization")
"""Filters without innovations, or in a map or on a path that a log does not have."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of a check."""
    parser.add_argument(
        "--check",
        action="store_true",
        help="also compare statistics of the log with those of its twins, logs drawn from the "
        "models along the smoothed path: prints what contradicts the models",
    )
    parser.add_argument(
        "--twins",
        type=int,
        default=100,
        metavar="N",
        help="number of twins of --check (default: 100)",
    )


def check_count(twins: int) -> None:
    """Raise InvalidField on too few twins."""
    require("--twins", twins, at_least(LEAST))


def check_log(
    world: Twin,
    filters: Mapping[str, Candidate],
    log: Log,
    twins: int,
    key: jax.Array,
    **options: Any,
) -> dict[str, ModelCheck]:
    """The check of a log by each of the filters that make a map of it; prints the others' names.

    options: devices, block and dtype, of `check_models`.
    """
    checks = {}
    for name, candidate in filters.items():
        if name in _OTHER or not isinstance(candidate, Filter):
            print(f"\n{name}: no check, which takes a filter that makes the map of the log")
            continue
        with Progress(f"{world.name}, {name}") as progress:
            checks[name] = check_models(
                world,
                candidate,
                log,
                twins=twins,
                key=key,
                filter_name=name,
                progress=progress,
                **options,
            )
        print(f"\n{checks[name]}")
    return checks


def check_files(checks: Mapping[str, ModelCheck]) -> Files:
    """The file of the checks; none without one."""
    if not checks:
        return {}
    content: Json = {name: summary_of(check) for name, check in checks.items()}
    return {CHECK: json_text(content)}


def summary_of(check: ModelCheck) -> Json:
    """A check as JSON."""
    return {
        "twins": check.twins,
        "left out": check.left_out,
        "doubt": check.doubt,
        "findings": list(check.findings),
        "statistics": [
            {
                "statistic": row.statistic.name,
                "log": json_number(row.statistic.value),
                "twins": [json_number(value) for value in row.twins],
                "twins below": row.rank,
                "p": row.p,
                "p corrected": row.corrected,
                "distance": json_number(row.distance),
                "finding": row.finding if row.contradicts else "",
            }
            for row in check.statistics
        ],
    }


def check_drawings(checks: Mapping[str, ModelCheck], formats: tuple[str, ...]) -> Drawings:
    """The figure of each check, by the name of its file."""

    def draw(stem: str, check: ModelCheck) -> Files:
        from jaxslam.results import plot  # matplotlib is slow to load
        from jaxslam.results.plot._style import pictures

        return {**pictures(stem, plot.check_figure(check), formats)}

    stems = {name: f"check-{name}" if len(checks) > 1 else "check" for name in checks}
    return {stem: lambda s=stem, n=name: draw(s, checks[n]) for name, stem in stems.items()}  # type: ignore[misc]
