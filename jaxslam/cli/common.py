"""Helpers of all commands: look-up by name, folders among the options, and a progress bar."""

import argparse
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

from jaxslam.consistency import DOF, Measure

_T = TypeVar("_T")

INTERRUPTED = 130
"""Exit status after Ctrl-C."""


def pick(kind: str, name: str, known: Mapping[str, _T]) -> _T:
    """The entry of `known` with a name; raises ValueError that lists the known names."""
    if name not in known:
        raise ValueError(f"unknown {kind} {name!r}; known: {', '.join(known)}")
    return known[name]


def as_folders(options: argparse.Namespace) -> None:
    """Convert the options that name folders to paths; raises ValueError on an empty name.

    `Path("")` would be the current folder.
    """
    for name in ("out", "resume", "cache"):
        text = getattr(options, name, None)
        if text is None:
            continue
        if not text.strip():
            raise ValueError(f"--{name}: expected a folder, got {text!r}")
        setattr(options, name, Path(text))


class Progress:
    """A progress bar on standard error; prints nothing where that is not a terminal."""

    def __init__(self, what: str, unit: str = "runs") -> None:
        self._what, self._unit = what, unit
        self._began = time.perf_counter()
        self._shown = sys.stderr.isatty()
        self._first: tuple[float, int] | None = None

    def __enter__(self) -> "Progress":
        self.say("compiling …")
        return self

    def say(self, what: str) -> None:
        """Show a word on the current stage of the work."""
        self._draw(f"{self._what}: {what}")

    def __call__(self, done: int, total: int) -> None:
        """Show how much is done and, from the second call on, the rate and the remaining time.

        The rate is measured from the first call, so it excludes compilation.
        """
        now = time.perf_counter()
        filled = round(30 * done / total)
        bar = "█" * filled + "░" * (30 - filled)
        line = f"{self._what}: {bar} {done:,}/{total:,} {self._unit}, {now - self._began:.0f} s"
        if self._first is None:
            self._first = now, done
        elif done > self._first[1] and now > self._first[0]:
            rate = (done - self._first[1]) / (now - self._first[0])
            line += f", {_rate(rate)} a second, {_duration((total - done) / rate)} left"
        self._draw(line)

    def glimpse(self, name: str, runs: int, nees: Measure | None) -> None:
        """Print a line with the pose NEES of a filter's first block, while others are compiled."""
        if self._shown and nees is not None:
            one = runs == 1
            shown = f"{nees.value:.3g}" + ("" if one else f" ({nees.low:.3g} to {nees.high:.3g})")
            of = "run" if one else f"block of {runs} runs"
            self._draw(f"{name}: pose NEES {shown} over a first {of}; honest is {DOF['pose']}\n")
            self.say("compiling …")

    def __exit__(self, *_: object) -> None:
        self._draw("")

    def _draw(self, line: str) -> None:
        if self._shown:
            print(f"\r\x1b[K{line}", end="", file=sys.stderr, flush=True)


def _rate(rate: float) -> str:
    return f"{rate:,.0f}" if rate >= 10 else f"{rate:.2g}"


def _duration(seconds: float) -> str:
    """A duration as text: 42 s, 3 min 5 s or 2 h 10 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600:,} h {whole % 3600 // 60} min"
