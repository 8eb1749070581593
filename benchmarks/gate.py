"""The result of a benchmark and its gate, and how benchmarks print tables and save figures."""

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from jaxslam.results.plot._style import png

FIGURES = Path(__file__).parent / "figures"


@dataclass(frozen=True)
class Metric:
    """A measured number and the range it must lie in.

    A metric of which more is better has the gate `low`, one of which less is better `high`, one
    with a known value both: the limit is what was asked, less a tolerance where a machine decides.
    """

    name: str
    value: float
    low: float = float("-inf")
    high: float = float("inf")
    note: str = ""

    @property
    def passes(self) -> bool:
        """Whether the value lies in its range; NaN does not."""
        return self.low <= self.value <= self.high


def report(metrics: list[Metric]) -> int:
    """Print the metrics with their gates; the exit status, 1 if any gate is missed."""
    width = max(len(m.name) for m in metrics)
    for m in metrics:
        gate = "" if m.low == -m.high == float("-inf") else f"[{m.low:.4g}, {m.high:.4g}]"
        verdict = "ok" if m.passes else "MISSED"
        print(f"{m.name:{width}}  {m.value:>10.4g}  {gate:>20}  {verdict:6}  {m.note}")
    missed = [m.name for m in metrics if not m.passes]
    print(f"{len(metrics) - len(missed)} of {len(metrics)} gates met")
    return 1 if missed else 0


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = ["| " + " | ".join(row) + " |" for row in (header, *rows)]
    return "\n".join([lines[0], "|" + "---|" * len(header), *lines[1:]])


def show(title: str, rows: Mapping[Any, Mapping[str, float | str]]) -> None:
    """Print a table of {row: {column: value}}."""
    columns = list(dict.fromkeys(column for row in rows.values() for column in row))
    cells = [["", *columns]]
    for name, row in rows.items():
        values = (row.get(column, "-") for column in columns)
        cells.append([str(name), *(v if isinstance(v, str) else f"{v:.4g}" for v in values)])
    first, *widths = (max(map(len, column)) for column in zip(*cells, strict=True))
    print(f"\n{title}")
    for name, *row in cells:
        aligned = (f"  {cell:>{width}}" for cell, width in zip(row, widths, strict=True))
        print(f"{name:{first}}" + "".join(aligned), flush=True)


def child(*arguments: object) -> Any:
    """What a Python process with these arguments prints as JSON, in its last line."""
    command = [sys.executable, *map(str, arguments)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def save(figure: Figure, name: str) -> None:
    """Write figures/NAME.png."""
    (FIGURES / f"{name}.png").write_bytes(png(figure))
