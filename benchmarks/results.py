"""The record of each benchmark, records/NAME.json, and RESULTS.md: a table of each."""

import contextlib
import datetime
import io
import json
import math
import os
import platform
import re
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

from benchmarks.gate import Metric, table

FILE, RECORDS = Path(__file__).with_name("RESULTS.md"), Path(__file__).with_name("records")
LIBRARIES = ("jax", "numpy")
HEAD = """# Results

Written by `python -m benchmarks --record [--only NAME,…]`, a table for each benchmark; nothing here
is typed by hand. [README.md](README.md) says what each benchmark does. A gate is the range in which
a result must lie. All numbers, and what each printed, are in [records](records), a file each.
"""


class Screen(io.StringIO):
    """Keeps what is printed, and prints it as well."""

    def write(self, text: str) -> int:
        sys.__stdout__.write(text)
        sys.__stdout__.flush()
        return super().write(text)


def processor() -> str:
    """The processor's name, its cores, and which vectors it has, as Linux tells."""
    file = Path("/proc/cpuinfo")
    text = file.read_text(encoding="utf-8") if file.exists() else ""
    model = re.search(r"model name\s*: (.*)", text)
    widest = [name for name in ("avx512f", "avx2", "avx") if name in text][:1]
    name = model[1] if model else platform.machine()
    return ", ".join([name, f"{os.cpu_count()} cores", *widest])


def measured(name: str, measure: Callable[[bool], list[Metric]], quick: bool) -> list[Metric]:
    """The metrics of a benchmark; they and what it printed become its record."""
    with contextlib.redirect_stdout(Screen()) as kept:
        metrics = measure(quick)
    versions = ", ".join(
        [f"Python {platform.python_version()}", *(f"{each} {version(each)}" for each in LIBRARIES)]
    )
    record = {
        "command": f"python -m benchmarks --record {'--quick ' * quick}--only {name}",
        "date": datetime.date.today().isoformat(),
        "processor": processor(),
        "versions": versions,
        "metrics": [
            {
                "name": m.name,
                "value": float(f"{m.value:.6g}"),
                "low": m.low if m.low > float("-inf") else None,
                "high": m.high if m.high < float("inf") else None,
                "note": m.note,
            }
            for m in metrics
        ],
        "printed": kept.getvalue().strip("\n").split("\n"),
    }
    text = json.dumps(record, indent=1, ensure_ascii=False) + "\n"
    (RECORDS / f"{name}.json").write_text(text, encoding="utf-8")
    FILE.write_text(page(), encoding="utf-8")
    return metrics


def recorded(name: str) -> dict[str, float]:
    """The values of a record by the names of its metrics; none where there is no record."""
    path = RECORDS / f"{name}.json"
    record = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"metrics": []}
    return {metric["name"]: metric["value"] for metric in record["metrics"]}


def page() -> str:
    """RESULTS.md: of each record its metrics with their gates."""
    parts = [HEAD]
    for path in sorted(RECORDS.glob("*.json")):
        record = json.loads(path.read_text(encoding="utf-8"))
        _, jax, _ = record["versions"].split(", ")
        parts.append(f"## {path.stem}\n\n{record['date']}, {record['processor']}, {jax}\n")
        rows = [[m["name"], f"{m['value']:.4g}", gate(**m), m["note"]] for m in record["metrics"]]
        for row in rows:  # cells left empty at the end of a row need no border
            while not row[-1]:
                row.pop()
        heads = ["metric", "value", "gate", "note"][: max(map(len, rows))]
        parts.append(table(heads, rows).strip() + "\n")
    return "\n".join(parts)


def gate(value: float, low: float | None, high: float | None, **_: str) -> str:
    """The range of a metric in words, and whether it was missed."""
    if low is None and high is None:
        return ""
    text = f"{low:.4g} … {high:.4g}" if low is not None and high is not None else ""
    text = text or (f"≥ {low:.4g}" if high is None else f"≤ {high:.4g}")
    least, most = (-math.inf if low is None else low), (math.inf if high is None else high)
    return text if least <= value <= most else f"{text} (missed)"
