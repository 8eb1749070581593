"""Devices to compute on, and the time of compilation."""

import contextlib
import threading
import time

import jax

from jaxslam.consistency.campaign.pieces import cores


def set_device_count(devices: str) -> None:
    """Set the number of CPU devices, before JAX first uses them; by default one per core.

    At most the number of cores; `chosen_devices` then refuses a larger request.
    """
    count = cores() if devices in ("all", "cpu") else int(devices) if devices.isdecimal() else None
    if count is not None and count < 1:
        raise ValueError(f"--devices: expected at least 1, got {devices}")
    if count is not None:
        with contextlib.suppress(RuntimeError):  # JAX is already in use, as in a notebook
            jax.config.update("jax_num_cpu_devices", min(count, cores()))


def chosen_devices(devices: str, most: int | None = None) -> list[jax.Device]:
    """The devices of this process for the option `--devices`: all, a number, or a platform.

    most: largest number for "all".
    """
    if devices == "all":
        return list(jax.local_devices()[:most])
    if devices.isdecimal():
        local = jax.local_devices()
        if int(devices) > len(local):
            kind = "CPU cores" if local[0].platform == "cpu" else local[0].platform
            raise ValueError(
                f"--devices: expected at most {len(local)}, the number of devices here ({kind}), "
                f"got {devices}"
            )
        return list(local[: int(devices)])
    try:
        return list(jax.local_devices(backend=devices))
    except RuntimeError as error:
        known = sorted({device.platform for device in jax.local_devices()} | {"cpu"})
        raise ValueError(
            f"--devices: expected all, a number, or one of {', '.join(known)}, got {devices!r}"
        ) from error


_PARTS = (
    "/jax/core/compile/jaxpr_trace_duration",
    "/jax/core/compile/jaxpr_to_mlir_module_duration",
    "/jax/core/compile/backend_compile_duration",
)


class CompileClock:
    """A context manager that measures wall time and compilation time, and counts programs.

    A program is traced, lowered, and compiled or loaded from the cache. Several threads compile at
    once while compiled programs run; `compiling` is the time during which at least one of them
    compiled.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._spans: list[tuple[float, float]] = []
        self.programs = 0
        """number of programs compiled or loaded from the cache"""
        self.cached = 0
        """number of programs loaded from the cache"""

    def __enter__(self) -> "CompileClock":
        self._began = time.perf_counter()
        jax.monitoring.register_event_duration_secs_listener(self._took)
        jax.monitoring.register_event_listener(self._happened)
        return self

    def __exit__(self, *_: object) -> None:
        jax.monitoring.unregister_event_duration_listener(self._took)
        jax.monitoring.unregister_event_listener(self._happened)

    @property
    def seconds(self) -> float:
        """Wall time since the block was entered [s]."""
        return time.perf_counter() - self._began

    @property
    def compiling(self) -> float:
        """Wall time during which a program was traced, lowered or compiled [s]."""
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
            f"{self.seconds:.1f} s in all, {self.compiling:.1f} s of them to compile or load "
            f"{made}: {self.programs - self.cached} compiled, {self.cached} loaded from the cache"
        )

    def _took(self, event: str, duration_secs: float, **_: str | int) -> None:
        if event in _PARTS:
            now = time.perf_counter()
            with self._lock:
                self._spans.append((now - duration_secs, now))
                # JAX reports a cached program as compiled, too.
                self.programs += event == _PARTS[-1]

    def _happened(self, event: str, **_: str | int) -> None:
        if event == "/jax/compilation_cache/cache_hits":
            with self._lock:
                self.cached += 1
