"""Scan matching: `python -m benchmarks.scan_matching [--quick]`.

Censi's experiment (square, corridor, circular room; σ = 0.03 m; 300 runs) and `office`: pairs of
scans at random poses of the world's path, the second up to 0.2 m, 0.1 m and 0.1 rad from the first,
starts with σ of 0.05 m, 0.05 m and 0.03 rad. NEES of every matcher with every covariance,
over the directions that the exact world says the scans determine, and errors beside the Cramér-Rao
bound. What the documentation recommends is judged again on other draws: the scale of its kernel was
chosen on the first.
Then 361-beam scans: matches a second and core, errors at σ = 0.01 m, errors over iterations.
Draws `figures/scan_matching_nees.png` and `figures/scan_matching_convergence.png`.
"""

import numpy as np

from benchmarks.consistency.markdown import table
from benchmarks.gate import Metric, alone
from benchmarks.scan_matching import draw, numbers
from benchmarks.scan_matching.honesty import (
    COVARIANCES,
    MATCHERS,
    RECOMMENDED,
    WORLDS,
    Error,
    Row,
    judged,
)


def measure(quick: bool = False) -> list[Metric]:
    matcher = RECOMMENDED[0]
    first, other = judged(30 if quick else 300, {0: tuple(MATCHERS), 1000: (matcher,)}).values()
    rows, errors = first
    print(f"\n{error_table(errors)}\n\n{nees_table(rows)}\n")
    draw.save(draw.nees(rows, errors), "scan_matching_nees")
    curves = numbers.convergence()
    draw.save(draw.convergence(curves), "scan_matching_convergence")
    return [
        *honest(rows, ""),
        *honest(other.rows, ", other draws"),
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
    lines = []
    for world in WORLDS:
        for matcher in MATCHERS:
            cells = []
            for way in COVARIANCES:
                row = by.get((world, matcher, way))
                cells.append("" if row is None else cell(row))
            lines.append([world, matcher, *cells])
    return table(["NEES/dof", "", *COVARIANCES], lines)


def cell(row: Row) -> str:
    """As 1.02 (honest), with the NEES along what the scans do not determine after a stroke."""
    along = "" if np.isnan(row.free) else f" / {row.free:.2g}"
    mark = "**" if row.verdict == "honest" else ""
    return f"{mark}{row.nees:.3g}{mark}{along}"


def honest(rows: list[Row], draws: str) -> list[Metric]:
    """Of what the documentation recommends; `draws` ends the names."""
    metrics = []
    for row in rows:
        if (row.matcher, row.way) == RECOMMENDED:
            low, high = {"square": (row.low, row.high), "office": (1 / 1.5, 1.5)}.get(
                row.world, (-np.inf, np.inf)
            )
            name = f"NEES/dof, PL-ICP (Cauchy) with implicit, {row.world}{draws}"
            metrics.append(Metric(name, row.nees, low, high))
            metrics.append(Metric(f"share in the 95 % ellipsoid, {row.world}{draws}", row.covered))
    return metrics


if __name__ == "__main__":
    quick = {"action": "store_true", "help": "30 runs"}
    raise SystemExit(alone("scan_matching", measure, quick=quick))
