"""The record of what a job on a laser log found."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxslam.datasets import LaserLog
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
    told: str = ""
    """what is printed below the summary"""
    more: Json | None = None
    """entries of `summary.json` that are printed in `told`"""


def scored(log: LaserLog, score: Callable[[], Json]) -> Json:
    """The score by the poses in the file, or why there is none: no poses, or they were the odometry
    as well."""
    if not log.placed:
        return {"score": "none: the file has no poses"}
    if np.allclose(log.raw, log.corrected, rtol=0, atol=1e-6):
        return {"score": "none: the odometry is equal to the poses that would score it"}
    return score()


def figure_files(name: str, figure: "Figure", formats: tuple[str, ...]) -> Files:
    """The functions that write a figure in some formats, by file name."""
    from jaxslam.results import plot  # matplotlib is slow to load

    def saved(kind: str) -> Callable[[Path], object]:
        return lambda path: path.write_bytes(plot.encode(figure, kind))

    return {f"{name}.{kind}": saved(kind) for kind in formats}
