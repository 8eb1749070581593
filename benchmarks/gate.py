"""The result of a benchmark and its gate, and how benchmarks print tables and save figures."""

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from jaxslam.core._table import Row, Table, markdown_of, text_of
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
    rows = []
    for m in metrics:
        gate = "" if m.low == -m.high == float("-inf") else f"[{m.low:.4g}, {m.high:.4g}]"
        rows.append(
            Row(m.name, [f"{m.value:.4g}", gate, "ok" if m.passes else "MISSED"], note=m.note)
        )
    print(text_of(Table((), rows)))
    missed = [m.name for m in metrics if not m.passes]
    print(f"{len(metrics) - len(missed)} of {len(metrics)} gates met")
    return 1 if missed else 0


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    return markdown_of(Table(header, [Row(name, cells) for name, *cells in rows]))


def show(title: str, rows: Mapping[Any, Mapping[str, float | str]]) -> None:
    """Print a table of {row: {column: value}}."""
    columns = list(dict.fromkeys(column for row in rows.values() for column in row))
    lines = []
    for name, row in rows.items():
        values = (row.get(column) for column in columns)
        cells = [v if v is None or isinstance(v, str) else f"{v:.4g}" for v in values]
        lines.append(Row(str(name), cells))
    print(f"\n{title}\n{text_of(Table(['', *columns], lines))}", flush=True)


def child(*arguments: object) -> Any:
    """What a Python process with these arguments prints as JSON, in its last line."""
    command = [sys.executable, *map(str, arguments)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def save(figure: Figure, name: str) -> None:
    """Write figures/NAME.png."""
    (FIGURES / f"{name}.png").write_bytes(png(figure))
