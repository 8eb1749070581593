"""The film of a run, of a trace or of a filter in a simulated world."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int, PyTree
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from numpy.typing import ArrayLike

from jaxslam._driver import run
from jaxslam.consistency.campaign._candidates import cast_floats, method_of
from jaxslam.core.protocols import Candidate, Filter
from jaxslam.core.types import Estimate, Log, Status, Trace, Truth
from jaxslam.core.validation import InvalidField, at_least, instance_of, refusals_of, require
from jaxslam.filters._delayed.state import DelayedState, covariance_blocks
from jaxslam.filters._information.eif_slam import CanonicalState
from jaxslam.filters._information.marginals import local_information
from jaxslam.filters._information.sparse_state import SparseState
from jaxslam.filters._particles.pose_particles import PoseParticles
from jaxslam.filters._particles.slam_particles import SlamParticles
from jaxslam.results.plot._film import Film, joined, robot_at, stage
from jaxslam.results.plot._landmarks import Limits, ellipses, extent, square_limits
from jaxslam.results.plot._style import COLORS, FAINT, INK, Look, own_settings, titled
from jaxslam.simulation._worlds import World, run_keys, with_positions, world_of_run

_CUT_FOR = 8
"""Number of frames in which a link that was cut is still shown."""

_MIN_STRENGTH = 0.2
"""Least strength with which a link to the robot is drawn."""

_WEAK = 1e-9
"""Strength of a link that is rounding alone."""


class Cloud(NamedTuple):
    """Particles, with leading T in a trace."""

    pose: Float[Array, "*T P 3"]
    weight: Float[Array, "*T P"]
    """Σ = 1, 0 where not in use"""


class Links(NamedTuple):
    """Links of the robot (row 0) and the landmarks (row 1 + slot), with leading T in a trace."""

    strength: Float[Array, "*T K K"]
    """‖Ω_ij‖ / √(‖Ω_ii‖ ‖Ω_jj‖) of the blocks of positions, at most 1; 0 without link"""


class Hypotheses(NamedTuple):
    """Points where stored measurements intersect, with leading T in a trace."""

    points: Float[Array, "*T C 2"]
    covs: Float[Array, "*T C 2 2"]
    persistence: Float[Array, "*T C"]
    """0 where not in use"""


def probe(state: PyTree) -> Cloud | Links | Hypotheses | None:
    """The part of the state that `animate` shows: particles, links or hypotheses.

        trace = jaxslam.run(filter, log, pose, pose_cov, key, probe=jaxslam.plot.probe)

    Of a particle filter, an information filter or `DelayedSlam`; None of others, as of `Mapping`.
    """
    if isinstance(state, SlamParticles | PoseParticles) and state.log_weight.ndim:
        return Cloud(state.pose, jnp.exp(state.log_weight))
    if isinstance(state, SparseState):
        slots = jnp.arange(state.alive.shape[0], dtype=jnp.int32)
        return _links(local_information(state, slots), 2)
    if isinstance(state, CanonicalState):
        return _links(state.omega, state.landmarks.shape[1], len(state.pose))
    if isinstance(state, DelayedState):
        # The hypotheses are after the slots of the landmarks, before the stored poses.
        joint, count = state.joint, state.persistence.shape[0]
        first = joint.alive.shape[0] - state.taken_at.shape[0] - count
        slot = first + np.arange(count)
        covs = covariance_blocks(joint)[slot, :2, slot, :2]
        persistence = jnp.where(joint.alive[slot], state.persistence, 0.0)
        return Hypotheses(joint.landmarks[slot, :2], covs, persistence)
    return None


def _links(omega: Float[Array, "D D"], size: int, robot: int = 3) -> Links:
    """The links of Ω of a robot of so many numbers and landmarks of `size` parameters."""
    # NumPy's arrays are constants, and cost no operation. Row 0 of `rows` is the robot's position,
    # row 1 + slot the position of a landmark, whose parameters begin with it.
    count = (omega.shape[0] - robot) // size
    landmarks = robot + np.arange(count)[:, None] * size + np.arange(2)
    rows = np.concatenate([np.arange(2)[None], landmarks])
    blocks = omega[rows[:, None, :, None], rows[None, :, None, :]]  # (K, K, 2, 2)
    norm = jnp.sqrt((blocks**2).sum(axis=(2, 3)))
    diagonal = jnp.sqrt(jnp.diagonal(norm))
    differ = ~np.eye(len(rows), dtype=bool)
    return Links(
        jnp.where(differ, norm / (diagonal[:, None] * diagonal[None, :]), 0.0).astype(jnp.float32)
    )


MOST = 100
"""Default of the largest number of frames: at ten a second a film lasts 10 s."""


def frame_steps(
    steps: int, most: int = MOST, time: Float[np.ndarray, "T"] | None = None
) -> Int[np.ndarray, "F"]:
    """The steps 0 … steps - 1 that are shown: all, or `most` of them, evenly in time.

    The first and the last are shown. In a gap of the times a step is shown several times.

    time: the time of each step, which does not go back; default: the number of the step.

    Raises ValueError without a step, on a `most` below 1, or on other times.
    """
    time = np.arange(steps, dtype=float) if time is None else np.asarray(time, float)
    with refusals_of("animate"):
        require("steps", steps, at_least(1))
        require("frames", most, at_least(1))
        if time.shape != (steps,) or not np.isfinite(time).all() or (np.diff(time) < 0).any():
            raise InvalidField("time", f"expected {steps} finite ones that do not go back")
    if steps <= most:
        return np.arange(steps)
    if most == 1:
        return np.array([steps - 1])
    at = np.searchsorted(time, np.linspace(time[0], time[-1], most), side="right") - 1
    at[0], at[-1] = 0, steps - 1
    return at


class History(NamedTuple):
    """A run of T steps with F frames, as NumPy arrays."""

    path: Float[np.ndarray, "T 3"]
    """the estimated pose of every step"""
    step: Int[np.ndarray, "F"]
    """the step of each frame, from 0"""
    estimate: Estimate
    """the whole estimate, with leading F"""
    tag: Int[np.ndarray, "T M"]
    """tag of each measurement"""
    status: Int[np.ndarray, "T M"]
    slot: Int[np.ndarray, "T M"]
    seen: Cloud | Links | Hypotheses | None = None
    """the result of `probe`, with leading F"""


def history_of(trace: Trace, log: Log, frames: int = MOST) -> History:
    """The history of a trace, at `frame_steps`.

    Raises ValueError on a trace that is not of one run over this log, or has no step.
    """
    with refusals_of("animate"):
        require("trace", trace, instance_of(Trace))
        require("log", log, instance_of(Log))
        path, status = np.asarray(trace.estimate.pose), np.asarray(trace.info.status)
        if path.ndim != 2 or path.shape[1] != 3:
            raise InvalidField("trace", f"expected that of one run, poses (T, 3), got {path.shape}")
    steps = frame_steps(len(path), frames)
    rows = np.shape(log.control)[0]
    if rows != len(path) or np.shape(log.scan.tag) != status.shape:
        raise InvalidField(
            "log",
            f"expected that of the trace, of {len(path)} steps and measurements {status.shape}, "
            f"got {rows} steps and measurements {np.shape(log.scan.tag)}",
            owner="animate",
        )
    estimate, seen = jax.tree.map(
        lambda leaf: np.asarray(leaf)[steps], (trace.estimate, trace.probe)
    )
    tag, slot = np.asarray(log.scan.tag), np.asarray(trace.info.slot)
    return History(path, steps, estimate, tag, status, slot, seen)


_OUTCOMES = {
    "fused": (Status.FUSED,),
    "new": (Status.BORN,),
    "stored": (Status.SIGHTED,),
    "dropped": tuple(set(Status) - {Status.EMPTY, Status.FUSED, Status.BORN, Status.SIGHTED}),
}


def beams_of(history: History) -> tuple[dict[str, list[np.ndarray]], dict[str, list[int]]]:
    """The beams since the previous frame, by outcome: their ends (E, 2, 2), and their numbers.

    A beam begins where the robot was estimated in that step, and ends at the landmark's estimate in
    the frame. A dropped measurement has the landmark of its tag; one of no landmark in the map is
    counted, without a beam.
    """
    beams: dict[str, list[np.ndarray]] = {name: [] for name in _OUTCOMES}
    counts: dict[str, list[int]] = {name: [] for name in _OUTCOMES}
    before = 0
    for k, step in enumerate(history.step):
        rows = slice(before, step + 1)
        before = step + 1
        status, slot, tag = history.status[rows], history.slot[rows], history.tag[rows]
        points, alive = history.estimate.points[k], np.asarray(history.estimate.alive[k])
        named = alive & (history.estimate.tag[k] >= 0)
        match = (tag[..., None] == history.estimate.tag[k]) & named
        by_tag = np.where(match.any(axis=-1), match.argmax(axis=-1), -1) if named.size else -1
        target = np.where(slot >= 0, slot, by_tag)
        in_map = (target >= 0) & (target < len(alive))
        # The entry False at the end is for targets that are not in the map.
        in_map &= np.append(alive, False)[np.where(in_map, target, -1)]
        for name, outcomes in _OUTCOMES.items():
            chosen = np.isin(status, outcomes)
            counts[name].append(int(chosen.sum()))
            row, place = np.nonzero(chosen & in_map)
            ends = [history.path[rows][row, :2], np.asarray(points)[target[row, place]]]
            beams[name].append(np.stack(ends, axis=1))
    return beams, counts


_NEAR = 1.5
"""Largest factor by which the estimate extends the limits of the truth."""

_ROBOT = 0.035
"""Length of the robot from its position to its tip, as a share of the map's side."""

_MANY = 60
"""Number of landmarks above which their marks are smaller."""

_BEAMS: dict[str, Look] = {
    "fused": {"color": COLORS[2], "lw": 0.8, "ls": "-"},
    "new": {"color": COLORS[4], "lw": 1.2, "ls": (0, (5, 2))},
    "stored": {"color": COLORS[5], "lw": 0.9, "ls": (0, (6, 1.3, 1.4, 1.3))},
    "dropped": {"color": INK, "lw": 0.9, "ls": (0, (1, 1.5))},
}
"""Beams by outcome of the measurement; dashes differ, for readers without colour."""

_RING: Look = {"color": COLORS[0], "lw": 1.0, "ls": (0, (3, 1))}
"""The ellipse of the robot."""


@own_settings()
def run_film(
    history: History,
    *,
    true_points: np.ndarray | None = None,
    true_path: np.ndarray | None = None,
    title: str = "",
) -> Film:
    """The film of a run: robot, beams, landmarks with 3 σ ellipses, and the truth in grey.

    A history with particles, links or hypotheses shows these, too. Beside the map is the error of
    the robot's position within its ellipse, on a fixed scale. The limits are those of the truth, or
    else of the estimate.

    Args:
        true_points: (N, 2) landmarks [m], in the frame of the map.
        true_path: (T, 3) poses in the frame of the map, NaN where not known.
    Raises:
        ValueError: on points or a path of other shapes.
    """
    steps = len(history.path)
    if true_points is not None and (np.ndim(true_points) != 2 or np.shape(true_points)[1] != 2):
        raise ValueError(
            f"animate: expected true points of shape (N, 2), got {np.shape(true_points)}"
        )
    if true_path is not None and np.shape(true_path) != (steps, 3):
        raise ValueError(
            f"animate: expected a true path of shape ({steps}, 3), got {np.shape(true_path)}"
        )
    true = None if true_path is None else np.asarray(true_path, float)
    pose, pose_cov, points, covs, alive, _ = map(np.asarray, history.estimate[:6])
    pose_cov = pose_cov[:, :2, :2]
    beams, counts = beams_of(history)
    without = (np.isnan(ellipses(m[a], c[a])) for m, c, a in zip(points, covs, alive, strict=True))
    lost = [int(of.all(axis=(1, 2)).sum()) for of in without]
    half, error = _scale_of_errors(history, true)
    is_known = np.isfinite(error).all(axis=1)
    beyond = is_known & (np.abs(error).max(axis=1) > half)
    limits = _limits(history, true_points, true)
    size, seen, count = _ROBOT * (limits[0][1] - limits[0][0]), history.seen, len(history.step)
    figure, (main, beside) = stage(*limits, beside=half)
    titled(beside, "about the estimated position" if true is None else "robot: truth − estimate")
    lines: dict[Line2D, Callable[[int], np.ndarray]] = {}
    robots: dict[Polygon, np.ndarray] = {}

    def line(of: Callable[[int], np.ndarray], axes: Axes = main, **look: Any) -> None:
        """A line through of(k) (N, 2) in frame k."""
        lines[axes.plot([], [], **look)[0]] = of

    def robot(poses: np.ndarray, **look: Any) -> None:
        patch = Polygon(np.zeros((3, 2)), closed=True, **look)
        robots[patch] = poses
        main.add_patch(patch)

    def rings(of: Callable[[int], tuple[np.ndarray, np.ndarray]], **look: Any) -> None:
        """3 σ ellipses of means and covariances; indefinite ones are left out."""
        line(lambda k: joined(ellipses(*of(k), points=48)), **look)

    dots: Look = {"ls": "none", "label": "_"}
    if true_points is not None:
        look: Look = {"color": FAINT, "ms": 5, "mew": 1.0, "zorder": 2}
        main.plot(*true_points.T, "x", label="true landmarks", **look)
    if true is not None:
        look = {"color": FAINT, "lw": 1.2, "ls": (0, (4, 2)), "zorder": 2.1}
        line(lambda k: true[: history.step[k] + 1, :2], label="truth: path, robot", **look)
        robot(true[history.step], fc="none", ec=FAINT, lw=1.2, zorder=5.5)
    links = {}
    if isinstance(seen, Links):
        ends, strength, cut = _links_of(seen, history.estimate)
        for name, (color, width) in _LINKS.items():
            look = {"color": color, "linewidth": width, "capstyle": "round", "zorder": 2.6}
            links[name] = LineCollection([], label=name, **look)
            main.add_collection(links[name], autolim=False)
        if any(map(len, cut)):
            look = {"color": INK, "lw": 1.0, "ls": (0, (1, 1.2)), "zorder": 2.8}
            line(lambda k: joined(cut[k]), label="link cut", **look)
    for name, look in _BEAMS.items():
        if any(map(len, beams[name])):
            ends_of = list(map(joined, beams[name]))
            line(ends_of.__getitem__, label=f"measured, {name}", zorder=3, **look)
    if isinstance(seen, Hypotheses):
        guesses = [np.asarray(seen.persistence[k]) > 0 for k in range(count)]
        look = {"color": COLORS[3], "lw": 0.9, "ls": (0, (2, 1.2)), "zorder": 3.8}
        at, wide = np.asarray(seen.points), np.asarray(seen.covs)
        guess = lambda k: (at[k][guesses[k]], wide[k][guesses[k]])  # noqa: E731
        rings(guess, label="hypothesis, 3 σ", **look)
        look = {"color": COLORS[3], "marker": "D", "mfc": "white", "ms": 3.5, "zorder": 3.9}
        line(lambda k: at[k][guesses[k]], **dots | look)
    if np.any(alive):
        mark = 3.2 if points.shape[1] <= _MANY else 1.8
        look = {"color": COLORS[1], "marker": "o", "ms": mark, "zorder": 4.1}
        line(lambda k: points[k][alive[k]], **dots | look)
        look = {"color": COLORS[1], "lw": 1.0, "zorder": 4, "label": "landmark, 3 σ"}
        rings(lambda k: (points[k][alive[k]], covs[k][alive[k]]), **look)
    look = {"color": COLORS[0], "lw": 1.4, "zorder": 3.5, "label": "estimate: path, robot"}
    line(lambda k: history.path[: history.step[k] + 1, :2], **look)
    clouds = []
    if isinstance(seen, Cloud):
        look = {"color": COLORS[7], "lw": 0, "alpha": 0.6, "zorder": 5.1}
        weight, particles = np.asarray(seen.weight), np.asarray(seen.pose)[..., :2]
        for axes, label, origin in ((main, "particles", 0 * pose), (beside, "_", pose)):
            scatter = axes.scatter([], [], label=label, **look)
            clouds.append((scatter, particles - origin[:, None, :2]))
    robot(pose, fc=COLORS[0], ec="white", lw=0.6, zorder=5)
    rings(lambda k: (pose[k, None, :2], pose_cov[k, None]), label="_", zorder=5.2, **_RING)
    center = np.zeros((1, 2))
    look = _RING | {"axes": beside, "label": "robot, 3 σ", "zorder": 4}
    rings(lambda k: (center, pose_cov[k, None]), **look)
    look = {"color": COLORS[0], "marker": "+", "ms": 7, "mew": 1.2, "zorder": 5}
    line(lambda k: center, beside, **dots | look)
    look = dots | {"color": INK, "marker": "X", "ms": 6.5, "zorder": 6, "clip_on": False}
    if true is not None:
        near = is_known & ~beyond
        line(lambda k: error[k, None][: int(near[k])], beside, **look | {"label": "true position"})
    if beyond.any():
        look |= {"label": "true position beyond", "mfc": "white"}
        line(lambda k: np.clip(error[k, None], -half, half)[: int(beyond[k])], beside, **look)

    def update(k: int) -> str:
        for artist, of in lines.items():
            artist.set_data(*of(k).T)
        for patch, poses in robots.items():
            patch.set_xy(robot_at(poses[k], size))
            patch.set_visible(bool(np.isfinite(poses[k]).all()))
        for scatter, places in clouds:
            shown = weight[k] > 0
            scatter.set_offsets(places[k][shown])
            scatter.set_sizes(np.clip(4.0 * weight[k][shown] * len(shown), 0.5, 60.0))
        for name, collection in links.items():
            heavy, (color, width) = np.sqrt(strength[name][k]), _LINKS[name]
            collection.set_segments(list(ends[name][k]))
            collection.set_linewidth(list(width * (0.15 + 0.85 * heavy)))
            collection.set_color([to_rgba(color, 0.2 + 0.6 * value) for value in heavy])
        numbers = {name: of[k] for name, of in counts.items() if of[k] or name != "stored"}
        total = sum(numbers.values())
        outcomes = ", ".join(f"{number} {name}" for name, number in numbers.items())
        parts = [f"step {history.step[k] + 1:,} of {steps:,}"]
        parts.append(f"{total} measurement{'s' * (total != 1)}: {outcomes}")
        if isinstance(seen, Hypotheses):
            number = guesses[k].sum()
            parts.append(f"{number} hypothes{'is' if number == 1 else 'es'}")
        parts += [f"{lost[k]} without ellipse"] if lost[k] else []
        parts += [] if np.isfinite(pose[k]).all() else ["pose not finite"]
        return " · ".join(parts)

    note = f"{count:,} of {steps:,} steps are shown, evenly in time" * (count < steps)
    return Film(figure, update, count, title=title, note=note)


def _limits(history: History, points: np.ndarray | None, path: np.ndarray | None) -> Limits:
    """The limits of the map: the truth, or else the estimate, extended by near points."""
    alive = history.estimate.alive
    mapped = np.asarray(history.estimate.points)[alive]
    covs = np.asarray(history.estimate.point_covs)[alive]
    reach = 3 * np.sqrt(np.maximum(np.diagonal(covs, axis1=1, axis2=2), 0.0))
    estimated = [history.path[:, :2], mapped]
    truth = [array for array in (points, path) if array is not None]
    clouds = [np.asarray(array, float)[:, :2] for array in truth] or estimated
    for array in (*estimated, np.concatenate([mapped - reach, mapped + reach])):
        if extent([*clouds, array]) <= _NEAR * extent(clouds):
            clouds = [*clouds, array]
    return square_limits(clouds)


def _scale_of_errors(history: History, path: np.ndarray | None) -> tuple[float, np.ndarray]:
    """Half of the side of the panel of errors, and truth less estimate (F, 2); NaN if not known."""
    pose, cov = (np.asarray(part) for part in history.estimate[:2])
    contours = ellipses(np.zeros((len(pose), 2)), cov[:, :2, :2])
    reach = np.abs(contours[np.isfinite(contours)]).max(initial=0.0)
    if isinstance(history.seen, Cloud):
        spread = np.abs(np.asarray(history.seen.pose)[..., :2] - pose[:, None, :2])
        reach = max(reach, float(np.quantile(np.append(spread[np.isfinite(spread)], 0.0), 0.995)))
    error = np.full((len(pose), 2), np.nan)
    if path is not None:
        error = path[history.step, :2] - pose[:, :2]
        largest = np.abs(error[np.isfinite(error).all(axis=1)]).max(initial=0.0)
        # Errors up to three times the ellipses are on the scale, larger ones at its edge.
        reach = max(reach, min(largest, 3 * reach) if reach > 0 else largest)
    return 1.08 * float(reach) or 1.0, error


_LINKS = {"link of landmarks": (COLORS[3], 3.0), "link to the robot": (COLORS[5], 5.0)}
"""Colour of the links of an information matrix, and their width at strength 1 [pt]; light ones are
thin and pale."""


def _links_of(
    seen: Links, estimate: Estimate
) -> tuple[dict[str, list[np.ndarray]], dict[str, list[np.ndarray]], list[np.ndarray]]:
    """Ends (E, 2, 2) of the links of each frame and their strengths, by kind, and recent cuts."""
    strength = np.asarray(seen.strength)
    strength = np.where(np.isfinite(strength) & (strength > _WEAK), strength, 0.0)
    ends: dict[str, list[np.ndarray]] = {name: [] for name in _LINKS}
    strengths: dict[str, list[np.ndarray]] = {name: [] for name in _LINKS}
    cut = []
    for k, step in enumerate(strength):
        nodes = np.concatenate([estimate.pose[k, None, :2], estimate.points[k]])
        linked = np.triu(step > 0)
        i, j = np.nonzero(linked)
        segments, weight = nodes[np.stack([i, j], axis=1)], np.minimum(step[i, j], 1.0)
        for name, chosen, least in zip(_LINKS, (i > 0, i == 0), (0.0, _MIN_STRENGTH), strict=True):
            ends[name].append(segments[chosen])
            strengths[name].append(np.maximum(weight[chosen], least))
        recent = np.triu(strength[max(0, k - _CUT_FOR) : k + 1].max(axis=0) > 0)
        alive = np.append(True, estimate.alive[k])
        gone = recent & ~linked & alive[:, None] & alive[None, :]
        cut.append(nodes[np.stack(np.nonzero(gone), axis=1)])
    return ends, strengths, cut


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
    steps, `frames` are shown, evenly in time, each with the beams since the previous one, and
    `film.note` says so.

    Args:
        trace: result of `run`, T steps.
        log: the log of the trace.
        truth: the truth of a simulated world; or
        true_points: (N, 2) landmarks [m], and
        true_path: (T, 3) poses, NaN where unknown, in the frame of the map.
        frames: the largest number of frames.
    Raises:
        ValueError: on arrays that do not belong together, or a trace without steps.
    """
    history = history_of(trace, log, frames)
    if truth is not None:
        with refusals_of("animate"):
            require("truth", truth, instance_of(Truth))
        true_points, true_path = np.asarray(truth.landmarks)[:, :2], truth.pose
    return run_film(
        history,
        true_points=None if true_points is None else np.asarray(true_points),
        true_path=None if true_path is None else np.asarray(true_path),
        title=title,
    )


def animate_world(
    scenario: World,
    candidate: Candidate,
    key: jax.Array,
    *,
    number: int = 0,
    dtype: DTypeLike | None = None,
    **options: Any,
) -> Film:
    """The film of a filter in a simulated world, with the `probe` of its state.

        world = jaxslam.scenarios.cloister()
        jaxslam.plot.animate_world(world, jaxslam.catalog.variant(world), jax.random.key(0))

    The world and the random numbers of the filter are those of a campaign's run of that number:
    `jaxslam consistency --seed 0` has key(0), and shows run 0.

    Args:
        candidate: a filter, or a function of the truth, as `monte_carlo` takes them.
        key: key of the campaign.
        number: number of the run.
        dtype: dtype of the filter, by default that of JAX.
        options: further arguments of `animate`.
    """
    with refusals_of("animate_world"):
        require("scenario", scenario, instance_of(World))
    truth, log = cast_floats(world_of_run(scenario, key, number), dtype)
    filter_key = run_keys(key, number)[1]
    with refusals_of("animate_world"):
        method = method_of(candidate, truth)
    if isinstance(method, Filter):
        trace = run(method, log, scenario.pose, scenario.pose_cov, filter_key, probe=probe)
    else:
        trace = method(log, filter_key)
    point_truth = with_positions(scenario.sensor, truth)
    return animate(trace, log, point_truth, **({"title": scenario.name} | options))
