"""The film of a run: of a trace, or of a filter in a simulated world."""

from typing import Any

import jax
import numpy as np
from jax.typing import DTypeLike
from numpy.typing import ArrayLike

from jaxslam.consistency.campaign.candidates import method_of, rounded
from jaxslam.core.protocols import Candidate, Filter
from jaxslam.core.types import Log, Trace, Truth
from jaxslam.core.validation import check_record
from jaxslam.results.plot.scene.film import Film
from jaxslam.results.plot.scene.history import MOST, history_of
from jaxslam.results.plot.scene.probe import probe
from jaxslam.results.plot.scene.run_scene import run_scene
from jaxslam.run import run
from jaxslam.simulation.worlds import World, run_keys, with_positions, world_of_run


def animate(
    trace: Trace,
    log: Log,
    truth: Truth | None = None,
    *,
    true_points: ArrayLike | None = None,
    true_path: ArrayLike | None = None,
    frames: int = MOST,
    title: str = "",
) -> Film:
    """The film of a run: the robot with its 3 σ ellipse, beams to the landmarks that are measured,
    landmarks with ellipses, the path so far, and the truth in grey.

        film = jaxslam.plot.animate(trace, log, truth)
        film.save("slam.gif")  # or .html, .mp4

    With a trace of `run(…, probe=jaxslam.plot.probe)` it shows the particles of a particle filter,
    the links of an information filter, and the hypotheses of `DelayedSlam`. Of more than `frames`
    steps so many are shown, evenly in time; a frame has the beams of the steps since the one
    before. `film.scene.note` says so.

    Args:
        trace, log: of `run`, T steps.
        truth: of a simulated world; or
        true_points: (N, 2) landmarks [m], and
        true_path: (T, 3) poses, NaN where unknown, in the frame of the map.
        frames: the largest number of frames.
    Raises:
        ValueError: on arrays that do not belong together, or a trace without steps.
    """
    history = history_of(trace, log, frames)
    if truth is not None:
        check_record("animate", "truth", truth, Truth)
        true_points, true_path = np.asarray(truth.landmarks)[:, :2], truth.pose
    scene = run_scene(
        history,
        true_points=None if true_points is None else np.asarray(true_points),
        true_path=None if true_path is None else np.asarray(true_path),
        title=title,
    )
    return Film(scene)


def animate_world(
    scenario: World,
    candidate: Candidate,
    key: jax.Array,
    *,
    number: int = 0,
    dtype: DTypeLike | None = None,
    **options: Any,
) -> Film:
    """The film of a filter in a simulated world, with what `probe` has of its state.

        world = jaxslam.scenarios.cloister()
        jaxslam.plot.animate_world(world, jaxslam.catalog.variant(world), jax.random.key(0))

    The world and the random numbers of the filter are those of a campaign's run of that number:
    `jaxslam consistency --seed 0` has key(0), and shows run 0.

    Args:
        candidate: a filter, or a function of the truth, as `monte_carlo` takes them.
        key: of the campaign. number: of the run. dtype: of the filter, by default that of JAX.
        options: of `animate`.
    """
    check_record("animate_world", "scenario", scenario, World)
    truth, log = rounded(world_of_run(scenario, key, number), dtype)
    of_filter = run_keys(key, number)[1]
    method = method_of(candidate, truth)
    if isinstance(method, Filter):
        trace = run(method, log, scenario.pose, scenario.pose_cov, of_filter, probe=probe)
    else:
        trace = method(log, of_filter)
    shown = with_positions(scenario.sensor, truth)
    return animate(trace, log, shown, **({"title": scenario.name} | options))
