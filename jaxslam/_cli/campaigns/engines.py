"""The executors of `jaxslam consistency --executor`."""

import contextlib
import re
from collections.abc import Iterator
from concurrent.futures import Future
from threading import Thread
from typing import Any

from jaxslam.consistency.campaign._remote import Executor, Processes
from jaxslam.core._optional import first_line, loading

_MPI = "mpiexec -n 4 python -m mpi4py.futures -m jaxslam consistency --executor mpi …"
_TIMEOUT = 10
"""Time to wait for an address that does not answer [s]."""


@contextlib.contextmanager
def engine(value: str | None) -> Iterator[tuple[Executor | None, int | None]]:
    """A context with the executor that an option names, and the number of blocks in flight.

    Raises ValueError on another value, on a library that cannot be used, and where no worker
    answers.
    """
    if value is None:
        yield None, None
    elif match := re.fullmatch(r"processes:([1-9]\d*)", value, re.ASCII):
        pool = Processes(int(match[1]))
        try:
            # Two blocks for each worker: the second waits while the first is computed.
            yield pool, 2 * int(match[1])
        finally:
            pool.shutdown()
    elif value == "mpi":
        with loading("--executor", "mpi4py"):
            from mpi4py import MPI
            from mpi4py.futures import MPIPoolExecutor

            ranks = MPI.COMM_WORLD.Get_size()
        if ranks < 2:
            raise ValueError(f"--executor: expected two ranks of MPI or more: {_MPI}")
        with MPIPoolExecutor() as executor:
            yield executor, 2 * executor.num_workers
    elif match := re.fullmatch(r"dask://(.+:\d+)", value, re.ASCII):
        with _dask_client(match[1]) as client:
            yield client.get_executor(pure=False), 2 * sum(client.nthreads().values())
    else:
        raise ValueError(
            f"--executor: expected processes:N, dask://HOST:PORT or mpi, got {value!r}"
        )


def _dask_client(address: str) -> Any:
    """The client of a Dask scheduler that has a worker."""
    with loading("--executor", "distributed"):
        from distributed import Client
    connected: Future[Any] = Future()

    def connect() -> None:
        try:
            connected.set_result(Client(f"tcp://{address}", timeout=_TIMEOUT))
        except BaseException as error:
            connected.set_exception(error)

    # In a thread, since Dask waits for ever for a service of another kind, as of HTTP.
    Thread(target=connect, daemon=True).start()
    try:
        client = connected.result(timeout=1.5 * _TIMEOUT)
    except Exception as error:  # of sockets, of time, of other versions of Dask
        raise ValueError(
            f"--executor: no Dask scheduler answers at {address} within {_TIMEOUT} s: `dask "
            f"scheduler` starts one, `dask worker {address}` its workers ({first_line(error)})"
        ) from error
    try:
        client.wait_for_workers(1, timeout=_TIMEOUT)
    except TimeoutError as error:
        client.close()
        raise ValueError(
            f"--executor: the Dask scheduler {address} has no workers: dask worker {address}"
        ) from error
    return client
