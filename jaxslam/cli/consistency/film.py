"""The films that `jaxslam consistency --animate` writes: run 0 of every filter."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import jax

from jaxslam.cli.films import film_files
from jaxslam.monte_carlo.progress import Progress
from jaxslam.protocols import Candidate
from jaxslam.results.files import write_files
from jaxslam.simulation.worlds import World

if TYPE_CHECKING:  # Pillow is slow to load
    from jaxslam.results.film import Film


def write_films(
    out: Path, scenario: World, filters: Mapping[str, Candidate], seed: int, dtype: str
) -> "dict[str, Film]":
    """Write the film of run 0 of every filter, which runs once more, and print what was written.

    Returns the films by filter.
    """
    from jaxslam.results import plot  # matplotlib is slow to load

    made: dict[str, Film] = {}
    for name, candidate in filters.items():
        title = f"{scenario.name}: {name}, run 0 of seed {seed}"
        with Progress(f"{name}: film", "frames") as progress:
            made[name] = plot.animate_world(
                scenario,
                candidate,
                jax.random.key(seed),
                dtype=dtype,
                title=title,
                progress=progress,
            )
    print("\nwrote " + ", ".join(map(str, write_files(out, film_files(made, suffixed=True)))))
    return made
