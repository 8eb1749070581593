"""Does precision decide a verdict unseen? Starts with σ 0 to 1 km, origins up to 10,000 km away.

A robot turns among four landmarks whose ranges and bearings it measures to 5 cm and 0.02 rad. Every
form of EKF-SLAM filters the same worlds in float32 and in float64. A verdict is right where it is
that of float64 at origin 0, in the square-root form if the method has one; it is doubted where the
campaign doubts the precision. In worlds that are moved next to their origin nothing may depend on
where that is; a filter of a user's class keeps its world where it is, and must be doubted there.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from benchmarks.gate import Metric, table
from jaxslam import Scenario, monte_carlo
from jaxslam.charts import LeftInvariant, RightInvariant
from jaxslam.consistency import Summary
from jaxslam.core.record import record
from jaxslam.filters import CompressedEkfSlam, EkfSlam, Filter, Wrapper
from jaxslam.linearize import FirstEstimate, Unscented
from jaxslam.motion import Increment
from jaxslam.sensors import RangeBearing

SIGMAS = (0.0, 0.1, 1.0, 10.0, 30.0, 100.0, 1000.0)
"""of x and y at the start [m]"""
ORIGINS = (0.0, 1e3, 1e5, 1e7)
"""of the start, in x and in y [m]"""
DTYPES = ("float64", "float32")
JOSEPH, ROOT = ", Joseph", ", square root"
Cell = tuple[str, float, float, str]
"""precision, σ, origin, form"""
RUNS, KEY = 32, jax.random.key(0)
MOTION, SENSOR = Increment(np.diag([0.02, 0.01]) ** 2), RangeBearing(np.diag([0.05, 0.02]) ** 2)


def world_of(sigma: float, origin: float) -> Scenario:
    """The world about a start at (origin, origin)."""
    points = np.array([[3.0, 2.0], [3.0, -2.0], [-1.0, 3.0], [5.0, 0.5]])
    return Scenario(
        name="four landmarks",
        motion=MOTION,
        sensor=SENSOR,
        landmarks=points + origin,
        controls=np.tile([0.1, 0.06], (100, 1)),
        pose=np.array([origin, origin, 0.0]),
        pose_cov=np.diag([sigma, sigma, 0.0]) ** 2,
    )


def forms() -> dict[str, Filter]:
    """EKF-SLAM in all forms of the covariance, orders of correction, charts and linearizers."""
    plain, points = EkfSlam(MOTION, SENSOR, 4), Unscented(alpha=1.0)
    options: dict[str, dict[str, Any]] = {
        "euclidean": {},
        "euclidean, joint": {"correction": "joint"},
        "right": {"chart": RightInvariant()},
        "right, joint": {"chart": RightInvariant(), "correction": "joint"},
        "first estimates": {"linearize": FirstEstimate()},
    }
    out: dict[str, Filter] = {}
    for name, given in options.items():
        out[name] = dataclasses.replace(plain, **given)
        out[name + ROOT] = dataclasses.replace(plain, **given, covariance="square_root")
    for name in ("euclidean", "euclidean, joint", "right"):
        out[name + JOSEPH] = dataclasses.replace(plain, **options[name], covariance="joseph")
    return out | {
        "iterated": dataclasses.replace(plain, iterations=3),
        "right, iterated": dataclasses.replace(plain, iterations=3, chart=RightInvariant()),
        "unscented": dataclasses.replace(plain, linearize=points),
        "right, unscented": dataclasses.replace(plain, linearize=points, chart=RightInvariant()),
        "left": dataclasses.replace(plain, chart=LeftInvariant()),
        "compressed": CompressedEkfSlam(plain, 4),
    }


@record
class Own(Wrapper):
    """A filter of a user's class."""

    filter: Filter


def measure(quick: bool = False) -> list[Metric]:
    """No verdict that differs from the right one, and no lost measurement, without a doubt."""
    sigmas, origins = ((0.1, 10.0), ORIGINS[::3]) if quick else (SIGMAS, ORIGINS)
    cells = _campaigns(forms(), sigmas, origins)
    _show(cells, sigmas)
    metrics = _counts(cells, "")
    # At 1 km some methods diverge in any precision.
    tame = {cell: summary for cell, summary in cells.items() if cell[1] <= 100}
    for dtype, high in zip(DTYPES, (1e-4, 1e-2), strict=True):
        changes = [
            abs(summary.measures["nees_pose"].value / at_0.measures["nees_pose"].value - 1)
            for (kind, sigma, _, name), summary in tame.items()
            if kind == dtype
            and not summary.doubts
            and not (at_0 := cells[kind, sigma, 0.0, name]).doubts
        ]
        what = f"{dtype}: change of a NEES by the origin, σ up to 100 m, relative"
        metrics.append(Metric(what, max(changes), high=high))
        lost = [
            summary.counts["singular"]
            for (kind, *_, name), summary in tame.items()
            if kind == dtype and name.endswith(ROOT)
        ]
        what = f"{dtype}: measurements lost by square-root forms, σ up to 100 m"
        metrics.append(Metric(what, sum(lost), high=0))
    own = {name: Own(forms()[name]) for name in ("euclidean", "right")}
    metrics += _counts(_campaigns(own, (0.1,), origins), ", of a user's class")
    return metrics


def _campaigns(
    filters: Mapping[str, Filter], sigmas: Sequence[float], origins: Sequence[float]
) -> dict[Cell, Summary]:
    """The summaries by precision, σ, origin and form."""
    return {
        (dtype, sigma, origin, name): summary
        for sigma in sigmas
        for origin in origins
        for dtype in DTYPES
        for name, summary in monte_carlo(
            world_of(sigma, origin), filters, RUNS, KEY, dtype=dtype, progress=False
        ).filters.items()
    }


def _right(cells: Mapping[Cell, Summary], cell: Cell) -> bool:
    """Whether a verdict is that of float64 at origin 0, by a root of the covariance if there is."""
    _, sigma, _, name = cell
    base = name.removesuffix(JOSEPH).removesuffix(ROOT)
    best = next(each for each in (base + ROOT, base) if ("float64", sigma, 0.0, each) in cells)
    return cells[cell].verdict == cells["float64", sigma, 0.0, best].verdict


def _counts(cells: Mapping[Cell, Summary], what: str) -> list[Metric]:
    """How many verdicts are right or wrong, with and without a doubt, by precision."""
    metrics = []
    for dtype in DTYPES:
        mine = {cell: summary for cell, summary in cells.items() if cell[0] == dtype}
        wrong = [cell for cell in mine if not _right(cells, cell)]
        silent = [cell for cell in wrong if not mine[cell].doubts]
        for cell in silent:
            print("wrong without a doubt:", *cell, mine[cell])
        right = sum(bool(summary.doubts) for summary in mine.values()) - len(wrong) + len(silent)
        of = f", of {len(mine)}{what}"
        metrics += [
            Metric(f"{dtype}: wrong verdicts without a doubt{of}", len(silent), high=0),
            Metric(f"{dtype}: wrong verdicts with a doubt{of}", len(wrong) - len(silent)),
            Metric(f"{dtype}: right verdicts with a doubt{of}", right),
        ]
    return metrics


def _show(cells: Mapping[Cell, Summary], sigmas: Sequence[float]) -> None:
    """Print NEES and NIS/dof in float32 at origin 0, * where doubted, ! where wrong."""

    def text(cell: Cell) -> str:
        summary = cells[cell]
        numbers = [
            f"{summary.measures[key].value:.3g}" if key in summary.measures else "-"
            for key in ("nees_pose", "nis_per_dof")
        ]
        marks = "*" * bool(summary.doubts) + "!" * (not _right(cells, cell))
        return f"{' / '.join(numbers)}{marks}"

    names = dict.fromkeys(name for *_, name in cells)
    rows = [[name, *(text(("float32", sigma, 0.0, name)) for sigma in sigmas)] for name in names]
    print("float32: NEES / NIS over dof by σ of the start [m]; * doubted, ! wrong verdict")
    print(table(["", *(f"{sigma:g}" for sigma in sigmas)], rows))
