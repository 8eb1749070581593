"""RESULTS.md: what the benchmarks printed, written by themselves, a section for each."""

import contextlib
import datetime
import io
import os
import platform
import re
import sys
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path

from benchmarks.consistency.markdown import table
from benchmarks.gate import Metric

FILE = Path(__file__).with_name("RESULTS.md")
LIBRARIES = ("jax", "numpy")
HEAD = """# Results

Written by `python -m benchmarks --record [--only NAME,…]`, a section for each benchmark; nothing
here is typed by hand. [README.md](README.md) says what each benchmark does. A gate is the range in
which a result must lie.
"""


class Screen(io.StringIO):
    """Keeps what is printed, and prints it as well."""

    def write(self, text: str) -> int:
        sys.__stdout__.write(text)
        sys.__stdout__.flush()
        return super().write(text)


@contextlib.contextmanager
def screen() -> Iterator[Screen]:
    """What is printed within, kept."""
    with contextlib.redirect_stdout(Screen()) as kept:
        yield kept


def processor() -> str:
    """The processor's name, its cores, and which vectors it has."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return platform.processor() or platform.machine()
    known = {
        key.strip(): value.strip()
        for key, _, value in (line.partition(":") for line in text.splitlines())
    }
    flags = known.get("flags", "").split()
    widest = next((name for name in ("avx512f", "avx2", "avx") if name in flags), "")
    cores = f"{os.cpu_count()} cores"
    return ", ".join(filter(None, (known.get("model name", platform.machine()), cores, widest)))


def measured(name: str, measure: Callable[[], list[Metric]], command: str) -> list[Metric]:
    """The metrics of a benchmark; they and what it printed become its section of RESULTS.md."""
    with screen() as kept:
        metrics = measure()
    versions = ", ".join(
        [f"Python {platform.python_version()}", *(f"{each} {version(each)}" for each in LIBRARIES)]
    )
    lines = [f"`{command}`, {datetime.date.today().isoformat()}; {processor()}; {versions}.", ""]
    if metrics:
        rows = [[m.name, f"{m.value:.4g}", gate(m), m.note] for m in metrics]
        lines += [table(["metric", "value", "gate", ""], rows), ""]
    if printed := kept.getvalue().strip("\n"):
        lines += [printed if "| --- |" in printed else f"```text\n{printed}\n```", ""]
    write(name, "\n".join(lines))
    return metrics


def gate(metric: Metric) -> str:
    """The range of a metric in words, and whether it was missed."""
    low, high = metric.low, metric.high
    text = {
        (False, False): "",
        (True, False): f"at least {low:.4g}",
        (False, True): f"at most {high:.4g}",
        (True, True): f"{low:.4g} to {high:.4g}",
    }[low > float("-inf"), high < float("inf")]
    return text if metric.passes else f"{text} (missed)"


def recorded() -> dict[str, str]:
    """The sections of RESULTS.md, by name."""
    if not FILE.exists():
        return {}
    parts = re.split(r"^## (\w+)$", FILE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def write(name: str, text: str) -> None:
    """Put a section in its place among the others, in alphabetical order; the rest stays."""
    sections = recorded()
    sections[name] = f"\n\n{text.strip()}\n\n"
    body = "".join(f"## {each}{sections[each]}" for each in sorted(sections))
    written = FILE.with_suffix(".new")
    written.write_text(f"{HEAD}\n{body}".rstrip() + "\n", encoding="utf-8")
    written.replace(FILE)
