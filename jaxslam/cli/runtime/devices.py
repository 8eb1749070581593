"""The devices that compute and the other processes of a campaign, set before JAX is first used."""

import argparse
import contextlib
import socket
import time

import jax
from jax.experimental import multihost_utils

from jaxslam.monte_carlo.pieces import cores


def prepare(options: argparse.Namespace) -> None:
    """Set the number of CPU devices, before JAX first uses them; by default one a core.

    Never more than there are cores, since JAX would create them; `chosen_devices` refuses
    such a request.
    """
    asked = options.devices
    count = cores() if asked in ("all", "cpu") else int(asked) if asked.isdecimal() else None
    if count is not None and count < 1:
        raise ValueError(f"--devices: expected at least 1, got {asked}")
    if count is not None:
        with contextlib.suppress(RuntimeError):  # JAX is already in use, as in a notebook
            jax.config.update("jax_num_cpu_devices", min(count, cores()))


def join_processes(options: argparse.Namespace) -> None:
    """Connect to the other processes of the campaign, where there are any.

    Raises ValueError on inconsistent options, and where the coordinator cannot be reached within
    options.timeout seconds.
    """
    address, count, mine = options.coordinator, options.processes, options.process_id
    if address is None:
        if count is not None or mine is not None:
            raise ValueError(
                "--processes, --process-id: expected --coordinator HOST:PORT with them, got none"
            )
        return
    if address == "auto":  # JAX reads the variables of SLURM, Kubernetes, Open MPI
        jax.distributed.initialize(initialization_timeout=options.timeout)
        return
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal():
        raise ValueError(f"--coordinator: expected HOST:PORT or auto, got {address!r}")
    if count is None or mine is None or count < 1 or not 0 <= mine < count:
        raise ValueError(
            f"--processes, --process-id: expected P >= 1 and I from 0 to P-1, got {count} and "
            f"{mine}"
        )
    if mine > 0:
        _await(host, int(port), options.timeout)
    try:
        jax.distributed.initialize(address, count, mine, initialization_timeout=options.timeout)
    except jax.errors.JaxRuntimeError as error:
        raise ValueError(
            f"--coordinator: not all of the {count} processes connected to {address} within "
            f"{options.timeout} s; raise --timeout ({str(error).splitlines()[0]})"
        ) from error


def chosen_devices(asked: str, most: int | None = None) -> list[jax.Device]:
    """This process's devices by what was asked for: all, their number, or a platform's name.

    most: how many are all.
    """
    if asked == "all":
        return list(jax.local_devices()[:most])
    if asked.isdecimal():
        there = jax.local_devices()
        if int(asked) > len(there):
            of = "each a core of the CPU" if there[0].platform == "cpu" else there[0].platform
            raise ValueError(
                f"--devices: expected at most {len(there)}, as many as there are here ({of}), "
                f"got {asked}"
            )
        return list(there[: int(asked)])
    try:
        return list(jax.local_devices(backend=asked))
    except RuntimeError as error:
        known = sorted({device.platform for device in jax.local_devices()} | {"cpu"})
        raise ValueError(
            f"--devices: expected all, a number, or one of {', '.join(known)}, got {asked!r}"
        ) from error


def wait_for_all(what: str) -> None:
    """Wait until every process of the campaign has come to this point."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(what)


def _await(host: str, port: int, timeout: int) -> None:
    """Wait until the coordinator listens; JAX itself would abort the program at the timeout."""
    end = time.monotonic() + timeout
    while True:
        try:
            with socket.create_connection((host, port), timeout=min(5, timeout)):
                return
        except OSError as error:
            if time.monotonic() >= end:
                raise ValueError(
                    f"--coordinator: no process 0 at {host}:{port} within {timeout} s: start it, "
                    f"or raise --timeout ({error})"
                ) from error
            time.sleep(0.2)
