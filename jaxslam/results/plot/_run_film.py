"""The film of a run, of a trace or of a filter in a simulated world."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int, PyTree
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
from jaxslam.results.plot._film import (
    Film,
    Layer,
    Panel,
    Scene,
    cloud,
    lines_between,
    marks,
    rings,
    still,
    track,
    triangle,
    weighted_segments,
)
from jaxslam.results.plot._landmarks import Limits, ellipses, extent, square_limits
from jaxslam.results.plot._style import COLORS, FAINT, INK, Look
from jaxslam.simulation._worlds import World, run_keys, with_positions, world_of_run

_ROBOT_LINK, _LINK = COLORS[5], COLORS[3]

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


def particle_layer(seen: Cloud, origin: np.ndarray, label: str) -> Layer:
    """The layer of the positions of particles, from an origin (F, 2)."""
    look: Look = {"color": COLORS[7], "lw": 0, "alpha": 0.6, "zorder": 5.1}
    at = np.asarray(seen.pose)[..., :2] - origin[:, None]
    return cloud(at, np.asarray(seen.weight), label=label, **look)


def hypothesis_layers(seen: object) -> list[Layer]:
    """The layers of points that may become landmarks; none where `seen` is not `Hypotheses`."""
    if not isinstance(seen, Hypotheses):
        return []
    points, covs, persistence = map(np.asarray, seen)
    shown = persistence > 0
    ring: Look = {"color": COLORS[3], "lw": 0.9, "ls": (0, (2, 1.2)), "zorder": 3.8}
    dots: Look = {"color": COLORS[3], "marker": "D", "mfc": "white", "ms": 3.5, "zorder": 3.9}
    return [
        rings(points, covs, shown, label="hypothesis, 3 σ", **ring),
        marks(points, shown, label="_", **dots),
    ]


def link_layers(seen: object, estimate: Estimate) -> list[Layer]:
    """The layers of the links of an information matrix, as wide as strong; recent cuts dotted.

    None where `seen` is not `Links`. estimate: with leading F, as the links.
    """
    if not isinstance(seen, Links):
        return []
    strength = np.asarray(seen.strength)
    strength = np.where(np.isfinite(strength) & (strength > _WEAK), strength, 0.0)
    between: list[np.ndarray] = []
    robot: list[np.ndarray] = []
    cut: list[np.ndarray] = []
    weights: dict[str, list[np.ndarray]] = {"between": [], "robot": []}
    for k, step in enumerate(strength):
        nodes = np.concatenate([estimate.pose[k, None, :2], estimate.points[k]])
        linked = np.triu(step > 0)
        recent = np.triu(strength[max(0, k - _CUT_FOR) : k + 1].max(axis=0) > 0)
        i, j = np.nonzero(linked)
        ends, weight = nodes[np.stack([i, j], axis=1)], np.minimum(step[i, j], 1.0)
        between.append(ends[i > 0])
        robot.append(ends[i == 0])
        weights["between"].append(weight[i > 0])
        weights["robot"].append(np.maximum(weight[i == 0], _MIN_STRENGTH))
        alive = np.append(True, estimate.alive[k])
        gone = recent & ~linked & alive[:, None] & alive[None, :]
        cut.append(nodes[np.stack(np.nonzero(gone), axis=1)])
    look: Look = {"capstyle": "round", "zorder": 2.6}
    dots: Look = {"color": INK, "lw": 1.0, "ls": (0, (1, 1.2)), "zorder": 2.8}
    landmarks: Look = look | {"width": 3.0, "label": "link of landmarks"}
    robots: Look = look | {"width": 5.0, "label": "link to the robot"}
    return [
        weighted_segments(between, weights["between"], color=_LINK, **landmarks),
        weighted_segments(robot, weights["robot"], color=_ROBOT_LINK, **robots),
        *([lines_between(cut, label="link cut", **dots)] if any(map(len, cut)) else []),
    ]


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


class FrameBeams(NamedTuple):
    """The measurements since the previous frame, for each of F frames."""

    beams: dict[str, list[Float[np.ndarray, "E 2 2"]]]
    """ends by outcome: the robot, and the landmark if it is in the map"""
    counts: dict[str, Int[np.ndarray, "F"]]
    """number of measurements, by outcome"""


_OUTCOMES = {
    "fused": (Status.FUSED,),
    "new": (Status.BORN,),
    "stored": (Status.SIGHTED,),
    "dropped": tuple(set(Status) - {Status.EMPTY, Status.FUSED, Status.BORN, Status.SIGHTED}),
}


def beams_of(history: History) -> FrameBeams:
    """The beams and counts of a history.

    A beam begins where the robot was estimated in that step, and ends at the landmark's estimate in
    the frame. A dropped measurement has the landmark of its tag, if that is in the map.
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
    return FrameBeams(beams, {name: np.array(numbers) for name, numbers in counts.items()})


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


def run_scene(
    history: History,
    *,
    true_points: np.ndarray | None = None,
    true_path: np.ndarray | None = None,
    title: str = "",
) -> Scene:
    """The scene of a run: robot, beams, landmarks with 3 σ ellipses, and the truth in grey.

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
    beams = beams_of(history)
    limits = _limits(history, true_points, true)
    side = limits[0][1] - limits[0][0]
    layers = [
        *_truth(history, true_points, true, _ROBOT * side),
        *link_layers(history.seen, history.estimate),
        *(
            lines_between(beams.beams[name], label=f"measured, {name}", zorder=3, **look)
            for name, look in _BEAMS.items()
            if any(map(len, beams.beams[name]))
        ),
        *hypothesis_layers(history.seen),
        *_map(history),
        *_robot(history, _ROBOT * side),
    ]
    return Scene(
        len(history.step),
        Panel(layers, *limits),
        _error_panel(history, true),
        _text(history, beams),
        title,
        f"{len(history.step):,} of {steps:,} steps are shown, evenly in time"
        * (len(history.step) < steps),
    )


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


def _truth(
    history: History, points: np.ndarray | None, path: np.ndarray | None, size: float
) -> list[Layer]:
    """The layers of the true map, path and robot, in grey."""
    layers = []
    if points is not None:
        look: Look = {"ls": "none", "marker": "x", "ms": 5, "mew": 1.0, "zorder": 2}
        layers.append(still(points, color=FAINT, label="true landmarks", **look))
    if path is not None:
        line: Look = {"lw": 1.2, "ls": (0, (4, 2)), "zorder": 2.1}
        named = "truth: path, robot"
        layers.append(track(path, history.step, color=FAINT, label=named, **line))
        robot: Look = {"fc": "none", "ec": FAINT, "lw": 1.2, "zorder": 5.5}
        layers.append(triangle(path[history.step], size, **robot))
    return layers


def _map(history: History) -> list[Layer]:
    """The layers of the landmarks with their ellipses; none for a filter without a map."""
    _, _, points, covs, alive, _ = map(np.asarray, history.estimate[:6])
    if not np.any(alive):
        return []
    ring: Look = {"color": COLORS[1], "lw": 1.0, "zorder": 4}
    size = 3.2 if points.shape[1] <= _MANY else 1.8
    dots: Look = {"color": COLORS[1], "marker": "o", "ms": size, "zorder": 4.1}
    return [
        marks(points, alive, label="_", **dots),
        rings(points, covs, alive, label="landmark, 3 σ", **ring),
    ]


def _robot(history: History, size: float) -> list[Layer]:
    """The layers of the path so far, particles, the robot's ellipse, and the robot."""
    pose, cov = (np.asarray(part) for part in history.estimate[:2])
    line: Look = {"color": COLORS[0], "lw": 1.4, "zorder": 3.5}
    ring: Look = {"color": COLORS[0], "lw": 1.0, "ls": (0, (3, 1)), "zorder": 5.2}
    robot: Look = {"fc": COLORS[0], "ec": "white", "lw": 0.6, "zorder": 5}
    layers = [track(history.path, history.step, label="estimate: path, robot", **line)]
    if isinstance(history.seen, Cloud):
        layers.append(particle_layer(history.seen, np.zeros((len(pose), 2)), "particles"))
    always = np.ones((len(pose), 1), bool)
    return [
        *layers,
        triangle(pose, size, **robot),
        rings(pose[:, None, :2], cov[:, None, :2, :2], always, label="_", **ring),
    ]


def _error_panel(history: History, path: np.ndarray | None) -> Panel:
    """The robot's position as seen from its estimate: the ellipse, the truth, particles."""
    pose, cov = (np.asarray(part) for part in history.estimate[:2])
    cov = cov[:, None, :2, :2]
    center, always = np.zeros((len(pose), 1, 2)), np.ones((len(pose), 1), bool)
    contours = ellipses(center[:, 0], cov[:, 0])
    reach = np.abs(contours[np.isfinite(contours)]).max(initial=0.0)
    ring: Look = {"color": COLORS[0], "lw": 1.0, "ls": (0, (3, 1)), "zorder": 4}
    layers = [rings(center, cov, always, label="robot, 3 σ", **ring)]
    dot: Look = {"color": COLORS[0], "marker": "+", "ms": 7, "mew": 1.2, "zorder": 5}
    layers.append(marks(center, always, label="_", **dot))
    if isinstance(history.seen, Cloud):
        layers.insert(0, particle_layer(history.seen, pose[:, :2], "_"))
        spread = np.abs(np.asarray(history.seen.pose)[..., :2] - pose[:, None, :2])
        spread = np.append(spread[np.isfinite(spread)], 0.0)
        reach = max(reach, float(np.quantile(spread, 0.995)))
    if path is not None:
        error = path[history.step, None, :2] - pose[:, None, :2]
        is_known = np.isfinite(error).all(axis=2)
        largest = np.abs(error[is_known]).max(initial=0.0)
        # Errors up to three times the ellipses are on the scale, larger ones at its edge.
        reach = max(reach, min(largest, 3 * reach) if reach > 0 else largest)
        half = 1.08 * reach or 1.0
        beyond = is_known & (np.abs(error).max(axis=2) > half)
        cross: Look = {"marker": "X", "ms": 6.5, "zorder": 6, "clip_on": False}
        layers.append(marks(error, is_known & ~beyond, label="true position", color=INK, **cross))
        if beyond.any():
            edge = np.clip(error, -half, half)
            look: Look = {"label": "true position beyond", "mfc": "white", "mec": INK}
            layers.append(marks(edge, beyond, **look, **cross))
    half = 1.08 * reach or 1.0
    return Panel(
        layers,
        (-half, half),
        (-half, half),
        title="about the estimated position" if path is None else "robot: truth − estimate",
    )


def _text(history: History, beams: FrameBeams) -> Callable[[int], str]:
    """The line above frame k: its step, and the outcomes of the measurements since frame k - 1."""
    total = len(history.path)
    lost = []
    for covs, alive in zip(history.estimate.point_covs, history.estimate.alive, strict=True):
        contours = ellipses(np.zeros((alive.sum(), 2)), covs[alive], points=1)
        lost.append(int(np.isnan(contours).all(axis=(1, 2)).sum()))

    def caption(k: int) -> str:
        counts = {name: int(numbers[k]) for name, numbers in beams.counts.items()}
        shown = [f"{count} {name}" for name, count in counts.items() if count or name != "stored"]
        parts = [f"step {history.step[k] + 1:,} of {total:,}"]
        measured = sum(counts.values())
        parts.append(f"{measured} measurement{'s' * (measured != 1)}: {', '.join(shown)}")
        if isinstance(history.seen, Hypotheses):
            count = int((np.asarray(history.seen.persistence[k]) > 0).sum())
            parts.append(f"{count} hypothes{'is' if count == 1 else 'es'}")
        parts += [f"{lost[k]} without ellipse"] if lost[k] else []
        parts += [] if np.isfinite(history.estimate.pose[k]).all() else ["pose not finite"]
        return " · ".join(parts)

    return caption


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
    `film.scene.note` says so.

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
