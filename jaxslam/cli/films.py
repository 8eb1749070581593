"""The files of films, and what is said of them."""

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # Pillow is slow to load
    from jaxslam.results.film import Film


NAMES = ("film.gif", "film.mp4", "film.html", "film-*.gif", "film-*.mp4", "film-*.html")
"""Patterns of the names of films: those of an earlier command do not stay beside its results."""


def film_files(
    films: Mapping[str, "Film"], *, suffixed: bool
) -> dict[str, Callable[[Path], object]]:
    """The functions that write each film as MP4, or else GIF, and as a page; by file name.

    Prints in a line how many steps are shown, and why there is no MP4.

    Args:
        films: by the name of the filter, which the file has where suffixed.
    """
    files: dict[str, Callable[[Path], object]] = {}
    said: dict[str, None] = {}
    for name, film in films.items():
        kind, content, why = film.moving()
        said |= dict.fromkeys(filter(None, (film.note, why)))
        stem = f"film-{name}" if suffixed else "film"
        for ending, held in ((kind, content), ("html", film.encoded("html"))):
            files[f"{stem}.{ending}"] = _writer(held)
    if said:
        print("\nfilm: " + "; ".join(said))
    return files


def _writer(content: bytes) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(content)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the option of films."""
    parser.add_argument(
        "--animate",
        action="store_true",
        help="also write a film of each filter (consistency: of run 0; of a laser log: the map "
        "growing): film.html to step and play, and film.mp4, or film.gif where ffmpeg is missing",
    )
