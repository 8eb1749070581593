"""The scene of one run of a filter: its map, and its robot seen from near."""

from collections.abc import Callable

import numpy as np

from jaxslam.results.plot.maps.geometry import Limits, ellipses, extent, square_limits
from jaxslam.results.plot.scene.film import Layer, Panel, Scene
from jaxslam.results.plot.scene.history import History, Measured, measured
from jaxslam.results.plot.scene.layers import (
    lines_between,
    marks,
    rings,
    still,
    track,
    triangle,
)
from jaxslam.results.plot.scene.probe import (
    Cloud,
    Hypotheses,
    hypothesis_layers,
    link_layers,
    particle_layer,
)
from jaxslam.results.plot.style import COLORS, FAINT, INK, Look

_NEAR = 1.5
"""What the estimate adds to the limits of the truth: at most this factor."""

_ROBOT = 0.035
"""length of the robot from its position to its tip, as a share of the map's side"""

_MANY = 60
"""With more landmarks their marks are smaller."""

_BEAMS: dict[str, Look] = {
    "fused": {"color": COLORS[2], "lw": 0.8, "ls": "-"},
    "new": {"color": COLORS[4], "lw": 1.2, "ls": (0, (5, 2))},
    "stored": {"color": COLORS[5], "lw": 0.9, "ls": (0, (6, 1.3, 1.4, 1.3))},
    "dropped": {"color": INK, "lw": 0.9, "ls": (0, (1, 1.5))},
}
"""Beams by what became of the measurement: another dash each, for readers without colour."""


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
    of the estimate where there is none.

    Args:
        true_points: (N, 2) landmarks [m], in the frame of the map.
        true_path: (T, 3) poses, NaN where not known, in the same.
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
    found = measured(history)
    limits = _limits(history, true_points, true)
    side = limits[0][1] - limits[0][0]
    layers = [
        *_truth(history, true_points, true, _ROBOT * side),
        *link_layers(history.seen, history.estimate),
        *_beams(found),
        *hypothesis_layers(history.seen),
        *_map(history),
        *_robot(history, _ROBOT * side),
    ]
    return Scene(
        len(history.step),
        Panel(layers, *limits),
        _nearby(history, true),
        _text(history, found),
        title,
        f"{len(history.step):,} of {steps:,} steps are shown, evenly in time"
        * (len(history.step) < steps),
    )


def _limits(history: History, points: np.ndarray | None, path: np.ndarray | None) -> Limits:
    """The limits of the map: of the truth, else the estimate; and of what is near of the rest."""
    alive = history.estimate.alive
    mapped = np.asarray(history.estimate.points)[alive]
    covs = np.asarray(history.estimate.point_covs)[alive]
    reach = 3 * np.sqrt(np.maximum(np.diagonal(covs, axis1=1, axis2=2), 0.0))
    estimated = [history.path[:, :2], mapped]
    clouds = [np.asarray(each, float)[:, :2] for each in (points, path) if each is not None]
    clouds = clouds or estimated
    for more in (*estimated, np.concatenate([mapped - reach, mapped + reach])):
        if extent([*clouds, more]) <= _NEAR * extent(clouds):
            clouds = [*clouds, more]
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


def _beams(found: Measured) -> list[Layer]:
    """The layers of the beams to measured landmarks, of the kinds that occur."""
    return [
        lines_between(found.beams[name], label=f"measured, {name}", zorder=3, **look)
        for name, look in _BEAMS.items()
        if any(map(len, found.beams[name]))
    ]


def _map(history: History) -> list[Layer]:
    """The layers of the map's landmarks with their ellipses; none of a filter without a map."""
    _, _, points, covs, alive, _ = map(np.asarray, history.estimate)
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
    here = np.ones((len(pose), 1), bool)
    return [
        *layers,
        triangle(pose, size, **robot),
        rings(pose[:, None, :2], cov[:, None, :2, :2], here, label="_", **ring),
    ]


def _nearby(history: History, path: np.ndarray | None) -> Panel:
    """The robot's position as seen from its estimate: the ellipse, the truth, particles."""
    pose, cov = (np.asarray(part) for part in history.estimate[:2])
    cov = cov[:, None, :2, :2]
    middle, here = np.zeros((len(pose), 1, 2)), np.ones((len(pose), 1), bool)
    contours = ellipses(middle[:, 0], cov[:, 0])
    reach = np.abs(contours[np.isfinite(contours)]).max(initial=0.0)
    ring: Look = {"color": COLORS[0], "lw": 1.0, "ls": (0, (3, 1)), "zorder": 4}
    layers = [rings(middle, cov, here, label="robot, 3 σ", **ring)]
    dot: Look = {"color": COLORS[0], "marker": "+", "ms": 7, "mew": 1.2, "zorder": 5}
    layers.append(marks(middle, here, label="_", **dot))
    if isinstance(history.seen, Cloud):
        layers.insert(0, particle_layer(history.seen, pose[:, :2], "_"))
        away = np.abs(np.asarray(history.seen.pose)[..., :2] - pose[:, None, :2])
        away = np.append(away[np.isfinite(away)], 0.0)
        reach = max(reach, float(np.quantile(away, 0.995)))
    if path is not None:
        off = path[history.step, None, :2] - pose[:, None, :2]
        known = np.isfinite(off).all(axis=2)
        far = np.abs(off[known]).max(initial=0.0)
        reach = max(reach, min(far, 3 * reach) if reach > 0 else far)
        half = 1.08 * reach or 1.0
        out = known & (np.abs(off).max(axis=2) > half)
        cross: Look = {"marker": "X", "ms": 6.5, "zorder": 6, "clip_on": False}
        layers.append(marks(off, known & ~out, label="true position", color=INK, **cross))
        if out.any():
            edge = np.clip(off, -half, half)
            look: Look = {"label": "true position beyond", "mfc": "white", "mec": INK}
            layers.append(marks(edge, out, **look, **cross))
    half = 1.08 * reach or 1.0
    return Panel(
        layers,
        (-half, half),
        (-half, half),
        title="about the estimated position" if path is None else "robot: truth − estimate",
    )


def _text(history: History, found: Measured) -> Callable[[int], str]:
    """The line above frame k: its step, and what became of the measurements since the last."""
    total = len(history.path)
    lost = []
    for covs, alive in zip(history.estimate.point_covs, history.estimate.alive, strict=True):
        contours = ellipses(np.zeros((alive.sum(), 2)), covs[alive], points=1)
        lost.append(int(np.isnan(contours).all(axis=(1, 2)).sum()))

    def said(k: int) -> str:
        counts = {name: int(of[k]) for name, of in found.counts.items()}
        shown = [f"{count} {name}" for name, count in counts.items() if count or name != "stored"]
        parts = [f"step {history.step[k] + 1:,} of {total:,}"]
        many = sum(counts.values())
        parts.append(f"{many} measurement{'s' * (many != 1)}: {', '.join(shown)}")
        if isinstance(history.seen, Hypotheses):
            count = int((np.asarray(history.seen.persistence[k]) > 0).sum())
            parts.append(f"{count} hypothes{'is' if count == 1 else 'es'}")
        parts += [f"{lost[k]} without ellipse"] if lost[k] else []
        parts += [] if np.isfinite(history.estimate.pose[k]).all() else ["pose not finite"]
        return " · ".join(parts)

    return said
