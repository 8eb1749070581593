"""A benchmark's result and its gate: a measured number and the range it must lie in."""

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax


@dataclass(frozen=True)
class Metric:
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


def alone(name: str, measure: Callable[..., list[Metric]], **options: dict[str, Any]) -> int:
    """The command `python -m benchmarks.NAME`: measure with its options, report; exit status.

    options: arguments of measure, each with what `add_argument` is told of it.
    """
    parser = argparse.ArgumentParser(prog=f"python -m benchmarks.{name}")
    for option, told in options.items():
        parser.add_argument(f"--{option}", **told)
    asked = vars(parser.parse_args())
    jax.config.update("jax_enable_x64", True)
    metrics = measure(**asked)
    print()
    return report(metrics) if metrics else 0
