"""The devices that compute, set before JAX is first used."""

import argparse
import contextlib

import jax

from jaxslam.consistency.campaign.pieces import cores


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
