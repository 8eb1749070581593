"""The files of films, and what is said of them."""

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from jaxslam.consistency.campaign.progress import Progress
from jaxslam.results.files import Files

if TYPE_CHECKING:  # Matplotlib is slow to load
    from jaxslam.results.plot import Film


NAMES = ("film.gif", "film.mp4", "film.html", "film-*.gif", "film-*.mp4", "film-*.html")
"""Patterns of the names of films: those of an earlier command do not stay beside its results."""


def film_files(films: Mapping[str, "Film"], *, suffixed: bool) -> Files:
    """The functions that write each film as MP4, or else GIF, and as a page; by file name.

    Prints in a line how many steps are shown, and why there is no MP4.

    Args:
        films: by the name of the filter, which the file has where suffixed.
    """
    from jaxslam.results import plot  # matplotlib is slow to load

    notes = dict.fromkeys(film.scene.note for film in films.values() if film.scene.note)
    kind = "mp4" if plot.has_ffmpeg() else "gif"
    said = [*notes, *(["ffmpeg is not installed: GIF instead of MP4"] if kind == "gif" else [])]
    if said:
        print("\nfilm: " + "; ".join(said))
    files: Files = {}
    for name, film in films.items():
        stem = f"film-{name}" if suffixed else "film"
        files |= {f"{stem}.{kind}": _with_progress(film, name), f"{stem}.html": film.save}
    return files


def _with_progress(film: "Film", name: str) -> Callable[[Path], object]:
    """The function that saves a film and shows how many frames are drawn."""

    def save(path: Path) -> None:
        with Progress(f"{name}: film", "frames") as progress:
            film.save(path, progress_callback=lambda k, of: progress(k + 1, of))

    return save


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the option of films."""
    parser.add_argument(
        "--animate",
        action="store_true",
        help="also write a film of each filter (consistency: of run 0; of a laser log: the map "
        "growing): film.html to step and play, and film.mp4, or film.gif where ffmpeg is missing",
    )
