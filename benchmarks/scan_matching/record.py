"""The tables of RESULTS.md, read again: the figure is drawn of them without the runs."""

import numpy as np

from benchmarks.results import recorded
from benchmarks.scan_matching.honesty import COVARIANCES, MATCHERS, Error, Row
from jaxslam.matching import MatchStatus
from jaxslam.math.stats import chi2_band


def tables() -> tuple[list[Row], list[Error]]:
    """NEES and errors, rounded as they were printed; `covered` is NaN, which no table has."""
    lines = [line.split("|")[1:-1] for line in recorded()["scan_matching"].splitlines()]
    cells = [[cell.strip() for cell in line] for line in lines]
    found = [row for row in cells if len(row) > 2 and row[1] in MATCHERS]
    errors = [_error(*row) for row in found if len(row) == 7]
    usable = {(e.world, e.matcher): e.usable for e in errors}
    rows = [
        _row(world, matcher, way, cell, usable[world, matcher])
        for world, matcher, *nees in found
        if len(nees) == len(COVARIANCES)
        for way, cell in zip(COVARIANCES, nees, strict=True)
        if cell
    ]
    return rows, errors


def _error(world: str, matcher: str, x: str, y: str, turn: str, over: str, told: str) -> Error:
    counts = [one.split() for one in told.split(", ")]
    statuses = {status: int(count) for count, status in counts}
    usable = [n for s, n in statuses.items() if MatchStatus[s.upper()] <= MatchStatus.DEGENERATE]
    deviation = np.array([float(x) / 1e3, float(y) / 1e3, np.radians(float(turn))])
    return Error(world, matcher, deviation, float(over), statuses, sum(usable))


def _row(world: str, matcher: str, way: str, cell: str, usable: int) -> Row:
    """A cell of the table: the NEES, and that along what two of the worlds do not determine."""
    nees, _, free = cell.replace("*", "").partition(" / ")
    dof = 2 if free else 3
    low, high = (bound / dof for bound in chi2_band(dof, usable))
    return Row(world, matcher, way, float(nees), low, high, np.nan, float(free or "nan"))
