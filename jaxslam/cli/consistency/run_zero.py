"""Run 0 of a campaign's filters: its films, and the estimate that the figures show."""

from collections.abc import Mapping
from pathlib import Path

import jax

from jaxslam.cli.films import film_files
from jaxslam.consistency.campaign.candidates import estimator_of, rounded
from jaxslam.core.protocols import Candidate
from jaxslam.core.types import Estimate, Truth
from jaxslam.results.files import write_files
from jaxslam.simulation.worlds import World, run_keys, world_of_run


def run_zero(
    scenario: World, candidate: Candidate, seed: int, dtype: str
) -> tuple[Truth, Estimate]:
    """Run 0 of a filter, computed again where an earlier command computed it."""
    key = jax.random.key(seed)
    truth, log = rounded(world_of_run(scenario, key, 0), dtype)
    method, _ = estimator_of(candidate, truth, scenario)
    estimate = method(log, run_keys(key, 0)[1]).estimate
    found: tuple[Truth, Estimate] = jax.device_get((truth, estimate))
    return found


def write_films(
    out: Path, scenario: World, filters: Mapping[str, Candidate], seed: int, dtype: str
) -> None:
    """Write the film of run 0 of every filter, which runs once more, and print what was written."""
    from jaxslam.results import plot  # matplotlib is slow to load

    films = {
        name: plot.animate_world(
            scenario,
            candidate,
            jax.random.key(seed),
            dtype=dtype,
            title=f"{scenario.name}: {name}, run 0 of seed {seed}",
        )
        for name, candidate in filters.items()
    }
    print("\nwrote " + ", ".join(map(str, write_files(out, film_files(films, suffixed=True)))))
