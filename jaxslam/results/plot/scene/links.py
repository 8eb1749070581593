"""The links of an information filter, as they appear and are cut."""

import numpy as np

from jaxslam.results.plot.scene.history import History
from jaxslam.results.plot.scene.layers import lines_between, weighted_segments
from jaxslam.results.plot.scene.probe import Links
from jaxslam.results.plot.scene.render import Layer
from jaxslam.results.plot.style import COLORS, INK, Look

_ROBOT_LINK, _LINK = COLORS[5], COLORS[3]

_CUT_FOR = 8
"""number of frames in which a link that was cut is still shown"""

_SEEN = 0.2
"""A link to the robot is drawn as if it were at least so strong."""

_WEAK = 1e-9
"""strength of a link that is rounding alone"""


def link_layers(history: History) -> list[Layer]:
    """The layers of the links of an information matrix, as wide as strong; lately cut ones dotted.

    None of a history without links.
    """
    if not isinstance(history.seen, Links):
        return []
    strength = np.asarray(history.seen.strength)
    strength = np.where(np.isfinite(strength) & (strength > _WEAK), strength, 0.0)
    between: list[np.ndarray] = []
    robot: list[np.ndarray] = []
    cut: list[np.ndarray] = []
    weights: dict[str, list[np.ndarray]] = {"between": [], "robot": []}
    for k, step in enumerate(strength):
        nodes = np.concatenate([history.estimate.pose[k, None, :2], history.estimate.points[k]])
        there = np.triu(step > 0)
        lately = np.triu(strength[max(0, k - _CUT_FOR) : k + 1].max(axis=0) > 0)
        i, j = np.nonzero(there)
        ends, weight = nodes[np.stack([i, j], axis=1)], np.minimum(step[i, j], 1.0)
        between.append(ends[i > 0])
        robot.append(ends[i == 0])
        weights["between"].append(weight[i > 0])
        weights["robot"].append(np.maximum(weight[i == 0], _SEEN))
        alive = np.append(True, history.estimate.alive[k])
        gone = lately & ~there & alive[:, None] & alive[None, :]
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
