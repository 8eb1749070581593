"""The blocks of a campaign on the workers of an executor: what is sent, and what a worker does."""

import functools
import pickle
import signal
import threading
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from multiprocessing import get_context
from typing import Any, Protocol

import jax
from jaxtyping import PyTree
from threadpoolctl import threadpool_limits

from jaxslam.consistency.campaign._block import BlockResult, BlockRunner, CampaignPlan
from jaxslam.core._optional import Unusable, first_line, loading

_SETTINGS = (
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)
"""The settings of JAX that a worker takes over: precision, and where programs are kept."""


class Executor(Protocol):
    """An engine that computes blocks elsewhere: any with the `submit` of `concurrent.futures`.

    What `submit` returns needs `done`, `exception` and `result`.
    """

    def submit(self, fn: Any, /, *args: Any) -> Any:
        """The future of fn(*args), which a worker computes."""


def pack(plan: CampaignPlan) -> bytes:
    """A plan and JAX's settings as bytes, which `compute_block` takes.

    Raises ValueError where a filter or the world cannot be pickled.
    """
    sent: PyTree = replace(plan, devices=[device.platform for device in plan.devices])
    settings = {name: getattr(jax.config, name) for name in _SETTINGS}
    pickler: Any = pickle
    hint = ""
    try:
        # By cloudpickle classes and functions of a script, a notebook or a file can be sent, too.
        with loading("a module holds it, or", "cloudpickle"):
            import cloudpickle

            pickler = cloudpickle
    except Unusable as lacking:
        hint = f": {lacking}"
    try:
        content: bytes = pickler.dumps((sent, settings))
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise ValueError(
            f"monte_carlo: executor: a filter or the world cannot be sent ({error}){hint}"
        ) from error
    return content


def compute_block(plan: bytes, first: int, runs: int) -> BlockResult:
    """The scores of runs first … first + runs - 1 on the first device of this process.

    The first call for a plan takes over JAX's settings and compiles; the next ones find its
    programs. plan: of `pack`.
    """
    with _COMPILING:
        runner = _runner(plan)
    # XLA uses the cores; additional threads of the BLAS below its LAPACK would only spin.
    with threadpool_limits(1, "blas"):
        return runner.block(first, runs)


_COMPILING = threading.Lock()
"""Held while a worker of several threads looks for a plan's programs, or compiles them."""


@functools.lru_cache(maxsize=1)
def _runner(plan: bytes) -> BlockRunner:
    try:
        sent, settings = pickle.loads(plan)
    except (ImportError, AttributeError) as error:  # cloudpickle, or a module of the user
        raise Unusable(
            f"monte_carlo: executor: a worker cannot read what is sent ({first_line(error)}): "
            "install there the packages that are installed here"
        ) from error
    for name, value in settings.items():
        if getattr(jax.config, name) != value:
            jax.config.update(name, value)
    device = jax.local_devices(backend=sent.devices[0])[0]
    runner = BlockRunner(replace(sent, devices=[device]))
    runner.compile()
    return runner


class Processes:
    """An executor of processes on this machine, each with one device of JAX.

    Where one is killed, Python's `ProcessPoolExecutor` gives up all; this one begins a new pool.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._pool = self._new()

    def _new(self) -> ProcessPoolExecutor:
        # JAX has threads, and a forked copy of a process with threads may hang. A terminal sends
        # Ctrl-C to the processes, too: they finish their blocks, which are kept.
        return ProcessPoolExecutor(
            self._count, get_context("spawn"), signal.signal, (signal.SIGINT, signal.SIG_IGN)
        )

    def submit(self, fn: Any, /, *args: Any) -> Future[Any]:
        """The future of fn(*args), which a process computes."""
        try:
            return self._pool.submit(fn, *args)
        except BrokenProcessPool:
            self._pool = self._new()
            return self._pool.submit(fn, *args)

    def shutdown(self) -> None:
        """End the processes; what they have not begun is cancelled."""
        self._pool.shutdown(cancel_futures=True)
