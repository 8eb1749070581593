"""Libraries and programs beyond the requirements: where one is of no use, a line says why."""

import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import PackageNotFoundError, version
from typing import NamedTuple


class Unusable(ImportError, ValueError):
    """A library or program that is missing, too old or broken; its text is one line."""


class _Library(NamedTuple):
    install: str
    lowest: str = ""
    """version, as in pyproject.toml; "" for any"""
    needs: str = ""
    """what else to install, where that is often missing"""


LIBRARIES = {
    "cloudpickle": _Library("pip install cloudpickle", "3.0"),
    "distributed": _Library("pip install 'jaxslam[dask]'", "2025.1"),
    "matplotlib": _Library("pip install matplotlib"),
    "mpi4py": _Library(
        "pip install 'jaxslam[mpi]'",
        "4.1",
        "install an MPI library, as Open MPI, or load its module (apt install openmpi-bin, module "
        "load openmpi)",
    ),
    "pandas": _Library("pip install pandas"),
    "rosbags": _Library("pip install 'jaxslam[ros]'", "0.11.6"),
}
"""By the name that is imported, which is that of the distribution, too."""


@contextmanager
def loading(caller: str, name: str) -> Iterator[None]:
    """A context for the import, and the first use, of a library of `LIBRARIES`.

        with loading("rosbag", "rosbags"):
            from rosbags.highlevel import AnyReader

    Whatever the library raises becomes `Unusable`; a version below the lowest is not tried.
    """
    library, installed = LIBRARIES[name], ""
    with suppress(PackageNotFoundError):  # a copy without metadata may serve
        installed = version(name)
    if () < _numbers(installed) < _numbers(library.lowest):
        raise Unusable(
            f"{caller}: {name} {installed} is too old, expected {library.lowest} or later: "
            f"{library.install}"
        )
    try:
        yield
    except Exception as error:  # RuntimeError of mpi4py without MPI, AttributeError, OSError, …
        if isinstance(error, ModuleNotFoundError) and error.name == name:
            raise Unusable(f"{caller}: {name} is not installed: {library.install}") from error
        mend = library.needs or f"pip install --force-reinstall {name}"
        raise Unusable(
            f"{caller}: {' '.join([name, *installed.split()])} is installed, but cannot be used "
            f"({first_line(error)}): {mend}"
        ) from error


def first_line(error: BaseException) -> str:
    """The kind of an error, and the first line of its text."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return ": ".join([type(error).__name__, *lines[:1]])


def _numbers(text: str) -> tuple[int, ...]:
    """The release of a version, as (0, 11, 6) of "0.11.6rc1", without zeros at its end."""
    release = re.match(r"\d+(\.\d+)*", text)
    return tuple(map(int, re.sub(r"(\.0+)+$", "", release[0]).split("."))) if release else ()
