"""Memory that is free, given back to the system."""

import ctypes
import sys


def give_back() -> None:
    """Give the system what this process has freed, where the C library can (glibc).

    XLA compiles in several threads, and glibc keeps what these free, some hundred MB after each
    compilation, for the same thread alone.
    """
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(ctypes.c_size_t(0))
