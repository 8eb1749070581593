"""Memory that compilations have freed, returned to the operating system."""

import ctypes
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import jax

_COMPILED = "/jax/core/compile/backend_compile_duration"
"""JAX's event at the end of a compilation."""


@contextmanager
def memory_returned() -> Iterator[None]:
    """Return freed memory to the system after each compilation in the block (glibc only).

    XLA compiles in several threads, and glibc keeps what these free, some hundred MB after each
    compilation, for the same thread alone.
    """

    def trim_after(event: str, duration_secs: float, **_: str | int) -> None:
        if event == _COMPILED:
            trim()

    jax.monitoring.register_event_duration_secs_listener(trim_after)
    try:
        yield
    finally:
        jax.monitoring.unregister_event_duration_listener(trim_after)


def trim() -> None:
    """Return the memory that this process has freed to the system, if the C library can."""
    if sys.platform == "linux":
        malloc_trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if malloc_trim is not None:
            malloc_trim(ctypes.c_size_t(0))
