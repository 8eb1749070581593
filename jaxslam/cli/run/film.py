"""The films that `jaxslam run --animate` writes."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int, PyTree

from jaxslam.cli.films import film_files
from jaxslam.cli.run.piecewise import PiecewiseRun
from jaxslam.datasets import Dataset
from jaxslam.datasets.evaluation import Evaluation
from jaxslam.results.files import Files


def film_steps(data: Dataset) -> Int[np.ndarray, "F"]:
    """The steps that a film of the data set shows."""
    from jaxslam.results import plot  # matplotlib is slow to load

    return plot.frame_steps(data.steps, time=data.time)


def shown_state(state: PyTree) -> PyTree:
    """What a film shows of a filter's own state."""
    from jaxslam.results import plot  # matplotlib is slow to load

    return plot.probe(state)


def films(
    data: Dataset, runs: Mapping[str, tuple[PiecewiseRun, Evaluation]], at: Int[np.ndarray, "F"]
) -> Files:
    """The functions that write the film of each filter, by file name; see `film_files`."""
    from jaxslam.results import plot  # matplotlib is slow to load

    made = {}
    for name, (run, found) in runs.items():
        assert run.estimates is not None
        scene = plot.run_scene(
            plot.History(
                path=np.asarray(run.path.pose),
                step=at,
                estimate=run.estimates,
                tag=np.asarray(data.log.scan.tag),
                status=run.status,
                slot=run.slot,
                seen=run.watched,
            ),
            true_points=found.points,
            true_path=_true_path(data, found),
            title=f"{data.name}: {name}",
        )
        made[name] = plot.Film(scene)
    return film_files(made, suffixed=len(made) > 1)


def _true_path(data: Dataset, found: Evaluation) -> Float[np.ndarray, "T 3"] | None:
    """The true poses in the frame of the map, NaN where they are not known."""
    if found.path is None:
        return None
    path = np.full((data.steps, 3), np.nan)
    path[np.ones(data.steps, bool) if data.true_at is None else data.true_at] = found.path
    return path
