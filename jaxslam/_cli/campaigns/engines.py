"""The executors of `jaxslam consistency --executor`."""

import contextlib
import importlib
import re
from collections.abc import Iterator
from types import ModuleType
from typing import Any

from jaxslam.consistency.campaign._remote import Executor, Processes

_MPI = "mpiexec -n 4 python -m mpi4py.futures -m jaxslam consistency --executor mpi …"
_TIMEOUT = 10
"""for an address that does not answer [s]"""


@contextlib.contextmanager
def engine(value: str | None) -> Iterator[tuple[Executor | None, int | None]]:
    """A context with the executor that an option names, and the number of blocks in flight.

    Raises ValueError on another value, on a library that is not installed, and where no worker
    answers.
    """
    if value is None:
        yield None, None
    elif found := re.fullmatch(r"processes:([1-9]\d*)", value, re.ASCII):
        pool = Processes(int(found[1]))
        try:
            yield pool, 2 * int(found[1])
        finally:
            pool.shutdown()
    elif value == "mpi":
        with _of_mpi() as pool:
            yield pool, 2 * pool.num_workers
    elif found := re.fullmatch(r"dask://(.+:\d+)", value, re.ASCII):
        with _client(found[1]) as client:
            yield client.get_executor(pure=False), 2 * sum(client.nthreads().values())
    else:
        raise ValueError(
            f"--executor: expected processes:N, dask://HOST:PORT or mpi, got {value!r}"
        )


def _of_mpi() -> Any:
    if _library("mpi4py.MPI", "mpi").COMM_WORLD.Get_size() < 2:
        raise ValueError(f"--executor: expected two ranks of MPI or more: {_MPI}")
    return importlib.import_module("mpi4py.futures").MPIPoolExecutor()


def _client(address: str) -> Any:
    distributed = _library("distributed", "dask")
    try:
        client = distributed.Client(f"tcp://{address}", timeout=_TIMEOUT)
    except (OSError, TimeoutError, ValueError) as error:
        raise ValueError(
            f"--executor: no Dask scheduler answers at {address} within {_TIMEOUT} s"
        ) from error
    try:
        client.wait_for_workers(1, timeout=_TIMEOUT)
    except TimeoutError as error:
        client.close()
        raise ValueError(f"--executor: the Dask scheduler {address} has no workers") from error
    return client


def _library(name: str, extra: str) -> ModuleType:
    """A module of an optional library; ValueError with the line that installs it."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ValueError(
            f"--executor: {name.partition('.')[0]} cannot be imported ({error}): "
            f"pip install 'jaxslam[{extra}]'"
        ) from error
