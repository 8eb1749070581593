"""What the commands share: names that must be known, and a bar of progress."""

import sys
import time
from collections.abc import Mapping
from typing import TypeVar

from jaxslam.consistency import DOF, Measure

_T = TypeVar("_T")

INTERRUPTED = 130
"""Exit status after Ctrl-C."""


def pick(kind: str, name: str, known: Mapping[str, _T]) -> _T:
    """What has that name, or ValueError with the names that are known."""
    if name not in known:
        raise ValueError(f"unknown {kind} {name!r}; known: {', '.join(known)}")
    return known[name]


class Progress:
    """A bar on a terminal; silent where the output is not one."""

    def __init__(self, what: str, unit: str = "runs") -> None:
        self._what, self._unit = what, unit
        self._began = time.perf_counter()
        self._shown = sys.stderr.isatty()

    def __enter__(self) -> "Progress":
        self.say("compiling …")
        return self

    def say(self, what: str) -> None:
        """Show what is being done."""
        self._draw(f"{self._what}: {what}")

    def __call__(self, done: int, total: int) -> None:
        """Show how much is done."""
        filled = round(30 * done / total)
        spent = time.perf_counter() - self._began
        bar = "█" * filled + "░" * (30 - filled)
        self._draw(f"{self._what}: {bar} {done:,}/{total:,} {self._unit}, {spent:.0f} s")

    def glimpse(self, name: str, runs: int, nees: Measure | None) -> None:
        """A line that stays: what the first block says of a filter, while others are compiled."""
        if self._shown and nees is not None:
            one = runs == 1
            shown = f"{nees.value:.3g}" + ("" if one else f" ± {nees.high - nees.value:.2g}")
            of = "run" if one else f"block of {runs} runs"
            self._draw(f"{name}: pose NEES {shown} over a first {of}; honest is {DOF['pose']}\n")
            self.say("compiling …")

    def __exit__(self, *_: object) -> None:
        self._draw("")

    def _draw(self, line: str) -> None:
        if self._shown:
            print(f"\r\x1b[K{line}", end="", file=sys.stderr, flush=True)
