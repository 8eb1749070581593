"""A progress bar, drawn only on a terminal or in a notebook."""

import os
import sys
import time
from collections.abc import Callable


class Progress:
    """A progress bar on a terminal's standard error or below a notebook's cell, gone at the end.

    Where there is neither, as in a pipe, or where the environment has TERM=dumb or
    JAXSLAM_PROGRESS=0, nothing is written and `shown` is false.
    """

    def __init__(self, title: str, unit: str = "runs") -> None:
        self._title, self._unit = title, unit
        self._began = time.perf_counter()
        environment = os.environ
        plain = environment.get("TERM") == "dumb" or environment.get("JAXSLAM_PROGRESS") == "0"
        self._terminal = not plain and sys.stderr is not None and sys.stderr.isatty()
        self._cell = None if plain or self._terminal else _notebook_cell()
        self._first: tuple[float, int] | None = None

    @property
    def shown(self) -> bool:
        """Whether there is a terminal or a notebook to show it."""
        return self._terminal or self._cell is not None

    def __enter__(self) -> "Progress":
        self.say("compiling …")
        return self

    def say(self, stage: str) -> None:
        """Show a word on the current stage of the work."""
        self._draw(f"{self._title}: {stage}")

    def __call__(self, finished: int, total: int) -> None:
        """Show how much is done and, from the second call on, the rate and the remaining time.

        The rate is measured from the first call, so it excludes compilation.
        """
        now = time.perf_counter()
        filled = round(30 * finished / total)
        bar = "█" * filled + "░" * (30 - filled)
        line = (
            f"{self._title}: {bar} {finished:,}/{total:,} {self._unit}, {now - self._began:.0f} s"
        )
        if self._first is None:
            self._first = now, finished
        elif finished > self._first[1] and now > self._first[0]:
            rate = (finished - self._first[1]) / (now - self._first[0])
            digits = f"{rate:,.0f}" if rate >= 10 else f"{rate:.2g}"
            line += f", {digits} a second, {_duration((total - finished) / rate)} left"
        self._draw(line)

    def __exit__(self, *_: object) -> None:
        self._draw("")

    def _draw(self, line: str) -> None:
        """Replace the last line."""
        if self._terminal:
            print(f"\r\x1b[K{line}", end="", file=sys.stderr, flush=True)
        elif self._cell is not None:
            self._cell(line)


def _notebook_cell() -> Callable[[str], object] | None:
    """A function that replaces a line of output below a notebook's cell; None elsewhere."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    if ipython is None or not hasattr(shell, "kernel"):
        return None
    handle = ipython.display.display({"text/plain": ""}, raw=True, display_id=True)
    return lambda line: handle.update({"text/plain": line}, raw=True)


def _duration(seconds: float) -> str:
    """A duration as text: 42 s, 3 min 5 s or 2 h 10 min."""
    total = round(seconds)
    if total < 60:
        return f"{total} s"
    if total < 3600:
        return f"{total // 60} min {total % 60} s"
    return f"{total // 3600:,} h {total % 3600 // 60} min"
