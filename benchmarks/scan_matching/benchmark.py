"""Scan matching.

Censi's experiment (square, corridor, circular room; σ = 0.03 m; 300 runs) and `office`: pairs of
scans at random poses of the world's path, the second up to 0.2 m, 0.1 m and 0.1 rad from the first,
starts with σ of 0.05 m, 0.05 m and 0.03 rad. NEES of every matcher with every covariance,
over the directions that the exact world says the scans determine, and errors beside the Cramér-Rao
bound. What the documentation recommends is judged again on other draws: the scale of its kernel was
chosen on the first.
Then 361-beam scans: matches a second and core, errors at σ = 0.01 m, errors over iterations.
"""

import numpy as np

from benchmarks.gate import Metric, save, table
from benchmarks.scan_matching import draw, numbers
from benchmarks.scan_matching.honesty import (
    COVARIANCES,
    MATCHERS,
    RECOMMENDED,
    WORLDS,
    Error,
    Row,
    judged,
    programs,
)


def measure(quick: bool = False) -> list[Metric]:
    compiled, runs = programs(MATCHERS), 30 if quick else 300
    rows, errors = judged(compiled, tuple(MATCHERS), runs, 0)
    other, _ = judged(compiled, RECOMMENDED[:1], runs, 1000)
    print(f"\n{error_table(errors)}\n\n{nees_table(rows)}\n")
    curves = numbers.convergence()
    if not quick:
        save(draw.nees(rows, errors), "scan_matching_nees")
        save(draw.convergence(curves), "scan_matching_convergence")
    return [
        *honest(rows, ""),
        *honest(other, ", other draws"),
        *numbers.orders(curves),
        *numbers.accuracy(50 if quick else 300),
        *numbers.speed(),
    ]


def error_table(errors: list[Error]) -> str:
    """Root mean square errors, beside the bound, and the statuses."""
    rows = [
        [
            e.world, e.matcher, *(f"{1e3 * d:.1f}" for d in e.deviation[:2]),
            f"{np.degrees(e.deviation[2]):.3f}", f"{e.over_bound:.3g}",
            ", ".join(f"{count} {status}" for status, count in e.statuses.items()),
        ]
        for e in errors
    ]  # fmt: skip
    header = ["world", "matcher", "x [mm]", "y [mm]", "θ [°]", "error² over bound", "status"]
    return table(header, rows)


def nees_table(rows: list[Row]) -> str:
    """NEES over degrees of freedom, a column a covariance; after a stroke, of what is not seen."""
    by = {(r.world, r.matcher, r.way): r for r in rows}
    lines = [
        [world, matcher, *(cell(by.get((world, matcher, way))) for way in COVARIANCES)]
        for world in WORLDS
        for matcher in MATCHERS
    ]
    return table(["NEES/dof", "", *COVARIANCES], lines)


def cell(row: Row | None) -> str:
    """**1.02** is honest; the NEES along what the scans do not determine follows a stroke."""
    if row is None:
        return ""
    along = "" if np.isnan(row.free) else f" / {row.free:.2g}"
    mark = "**" if row.low <= row.nees <= row.high else ""
    return f"{mark}{row.nees:.3g}{mark}{along}"


def honest(rows: list[Row], draws: str) -> list[Metric]:
    """Of what the documentation recommends; `draws` ends the names."""
    metrics = []
    for row in rows:
        if (row.matcher, row.way) == RECOMMENDED:
            gates = {"square": (row.low, row.high), "office": (1 / 1.5, 1.5)}
            name = f"NEES/dof, PL-ICP (Cauchy) with implicit, {row.world}{draws}"
            metrics.append(Metric(name, row.nees, *gates.get(row.world, ())))
            metrics.append(Metric(f"share in the 95 % ellipsoid, {row.world}{draws}", row.covered))
    return metrics
