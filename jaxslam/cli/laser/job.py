"""The record of what a job on a laser log found."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from jaxslam.results.files import Files, Json

if TYPE_CHECKING:  # Matplotlib is slow to load
    from jaxslam.results.plot.style import Figure


class Job(NamedTuple):
    """The result of a job, for the screen and the folder of results."""

    summary: Json
    """entries of the summary"""
    files: Files
    figures: Callable[[tuple[str, ...]], Files]
    """(formats) -> the figures"""


def figure_files(name: str, figure: "Figure", formats: tuple[str, ...]) -> Files:
    """The functions that write a figure in some formats, by file name."""
    from jaxslam.results import plot  # matplotlib is slow to load

    def saved(kind: str) -> Callable[[Path], object]:
        return lambda path: path.write_bytes(plot.encode(figure, kind))

    return {f"{name}.{kind}": saved(kind) for kind in formats}
