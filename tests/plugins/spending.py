"""A pytest plugin: what each test file costs, large files first, and memory given back after each.

At the end of a run it prints the worst files. Under pytest-xdist every worker counts its own and
sends the counts to the controller.
"""

import contextlib
import ctypes
import gc
import resource
import sys
import time
from collections import defaultdict

import jax
import pytest

WORST = 10
"""How many files are printed."""

ROOM = 0.8, 1.3
"""Resident memory [GB] of a worker above which compiled programs are dropped: after a file, and
after a test."""

COLUMNS = ("compiled", "from cache", "compile s", "cpu s", "wall s")


class Spending:
    """Counts by file: programs compiled, programs read from the cache, seconds."""

    def __init__(self, config):
        self.config = config
        self.by_file = defaultdict(lambda: [0.0] * len(COLUMNS))
        self.peaks = {}
        self.current = None
        jax.monitoring.register_event_duration_secs_listener(self.on_duration)
        jax.monitoring.register_event_listener(self.on_event)

    def add(self, *amounts):
        if self.current is not None:
            row = self.by_file[self.current]
            for i, amount in enumerate(amounts):
                row[i] += amount

    def on_duration(self, event, seconds, **_):
        if event == "/jax/core/compile/backend_compile_duration":
            self.add(1, 0, seconds)

    def on_event(self, event, **_):
        if event == "/jax/compilation_cache/cache_hits":
            self.add(-1, 1)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item, nextitem):
        self.current = item.location[0]
        wall, cpu = time.perf_counter(), processor_seconds()
        try:
            return (yield)
        finally:
            self.add(0, 0, 0, processor_seconds() - cpu, time.perf_counter() - wall)
            ended = nextitem is None or nextitem.location[0] != self.current
            if resident() > ROOM[0 if ended else 1] * 2**30 or share_of_maps() > 0.5:
                give_back()

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_modifyitems(self, items):
        size = {item.path: item.path.stat().st_size for item in items}
        items.sort(key=lambda item: (-size[item.path], item.location[0]))

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self):
        worker = getattr(self.config, "workeroutput", None)
        if worker is not None:
            worker["spending"] = dict(self.by_file), peak()

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node):
        by_file, most = getattr(node, "workeroutput", {}).get("spending", ({}, 0))
        self.peaks[node.gateway.id] = most
        for name, row in by_file.items():
            self.by_file[name] = [a + b for a, b in zip(self.by_file[name], row, strict=True)]

    def pytest_terminal_summary(self, terminalreporter):
        rows = sorted(self.by_file.items(), key=lambda item: -item[1][3])
        total = [sum(column) for column in zip(*self.by_file.values(), strict=True)]
        if not rows:
            return
        terminalreporter.section(f"the {min(WORST, len(rows))} most expensive files")
        terminalreporter.line("".join(f"{name:>12}" for name in COLUMNS))
        for name, row in [*rows[:WORST], ("all files", total)]:
            terminalreporter.line("".join(f"{value:12.0f}" for value in row) + f"  {name}")
        peaks = self.peaks or {"this process": peak()}
        each = ", ".join(f"{name} {size / 2**30:.2f} GB" for name, size in sorted(peaks.items()))
        terminalreporter.line(f"peak memory: {each}")


def processor_seconds():
    """Of this process and of those it started and waited for."""
    waited_for = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + waited_for.ru_utime + waited_for.ru_stime


def peak():
    """The most memory [bytes] that was resident at once."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def resident():
    """Bytes resident now; the peak where the system does not tell."""
    try:
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * resource.getpagesize()
    except OSError:
        return peak()


def share_of_maps():
    """The process's memory maps by those that Linux grants: a program has some hundred, and beyond
    them LLVM ends the process."""
    try:
        with open("/proc/sys/vm/max_map_count") as most, open("/proc/self/maps", "rb") as maps:
            return sum(1 for _ in maps) / int(most.read())
    except OSError:
        return 0.0


def give_back():
    """Drop the programs that JAX keeps, and return what they took."""
    jax.clear_caches()
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):  # glibc alone has it
        ctypes.CDLL(None).malloc_trim(0)
    with contextlib.suppress(OSError, AttributeError):  # and jemalloc this: all of its arenas
        ctypes.CDLL(None).mallctl(b"arena.4096.purge", None, None, None, 0)
