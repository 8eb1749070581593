"""What a command spent on compiling, and what on all else."""

import threading
import time
from typing import Any

import jax

from jaxslam.monte_carlo.blockwise import RESTORED

_PARTS = (
    "/jax/core/compile/jaxpr_trace_duration",
    "/jax/core/compile/jaxpr_to_mlir_module_duration",
    "/jax/core/compile/backend_compile_duration",
    RESTORED,
)


class Spent:
    """A clock, as a context: wall seconds, and how long some program was being made meanwhile.

    A program is traced, lowered, and compiled or taken from the cache. Several are at once, and
    finished ones run beside them; `compiling` is the time during which at least one was at it.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._spans: list[tuple[float, float]] = []
        self.programs = 0
        """compiled, or taken from the cache"""
        self.cached = 0
        """taken from the cache"""

    def __enter__(self) -> "Spent":
        self._began = time.perf_counter()
        jax.monitoring.register_event_duration_secs_listener(self._took)
        jax.monitoring.register_event_listener(self._happened)
        return self

    def __exit__(self, *_: object) -> None:
        jax.monitoring.unregister_event_duration_listener(self._took)
        jax.monitoring.unregister_event_listener(self._happened)

    @property
    def seconds(self) -> float:
        """Wall time so far."""
        return time.perf_counter() - self._began

    @property
    def compiling(self) -> float:
        """Wall time during which a program was being traced, lowered or compiled."""
        total, at = 0.0, self._began
        with self._lock:
            spans = sorted(self._spans)
        for begin, end in spans:
            total += max(end - max(begin, at), 0.0)
            at = max(at, end)
        return total

    def __str__(self) -> str:
        made = f"{self.programs} programs" if self.programs != 1 else "1 program"
        return (
            f"{self.seconds:.1f} s in all, {self.compiling:.1f} s of them to make {made}: "
            f"{self.programs - self.cached} compiled, {self.cached} loaded from the cache"
        )

    def _took(self, event: str, duration_secs: float, **_: Any) -> None:
        if event in _PARTS:
            now = time.perf_counter()
            with self._lock:
                self._spans.append((now - duration_secs, now))
                self.programs += event in _PARTS[-2:]  # a cached one is "compiled" all the same
                self.cached += event == RESTORED

    def _happened(self, event: str, **_: Any) -> None:
        if event == "/jax/compilation_cache/cache_hits":
            with self._lock:
                self.cached += 1
