"""The kinds of lines in files of graphs: vertices and edges of g2o and TORO."""

from typing import NamedTuple


class Edge(NamedTuple):
    """What a line of one kind holds."""

    table: str
    who: tuple[str, ...]
    """kinds of the variables, "pose" or "point" """
    measured: tuple[str, ...]
    entries: tuple[tuple[int, int], ...]
    """where in Ω each number stands"""


_BY_ROWS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
TORO_ORDER = ((0, 0), (0, 1), (1, 1), (2, 2), (0, 2), (1, 2))
_POSE = ("x", "y", "theta")
EDGES = {
    "EDGE_SE2": Edge("relative_pose", ("pose", "pose"), _POSE, _BY_ROWS),
    "EDGE2": Edge("relative_pose", ("pose", "pose"), _POSE, TORO_ORDER),
    "EDGE": Edge("relative_pose", ("pose", "pose"), _POSE, TORO_ORDER),
    "EDGE_PRIOR_SE2": Edge("prior", ("pose",), _POSE, _BY_ROWS),
    "EDGE_SE2_XY": Edge(
        "relative_position", ("pose", "point"), ("x", "y"), ((0, 0), (0, 1), (1, 1))
    ),
    "EDGE_BEARING_SE2_XY": Edge("bearing", ("pose", "point"), ("bearing",), ((0, 0),)),
}
VERTICES = {
    "VERTEX_SE2": ("pose", _POSE),
    "VERTEX2": ("pose", _POSE),
    "VERTEX": ("pose", _POSE),
    "VERTEX_XY": ("point", ("x", "y")),
}
SKIPPED = {
    "ROBOTLASER1": "laser scans",
    "PARAMS_SE2OFFSET": "sensor offsets",  # no edge of EDGES refers to one
    "VERTEX_TAG": "notes",
    "VERTEX_ELLIPSE": "notes",
}
"""Lines that are no part of the graph, and what they are counted as."""


class Format(NamedTuple):
    """The kinds of lines that a graph is written in."""

    name: str
    vertices: dict[str, str]
    """of "pose" and "point" """
    edges: dict[str, str]
    """by table"""
    fix: bool
    """whether a variable can be held"""


G2O = Format(
    "g2o",
    {"pose": "VERTEX_SE2", "point": "VERTEX_XY"},
    {edge.table: kind for kind, edge in EDGES.items() if edge.entries != TORO_ORDER},
    fix=True,
)
TORO = Format("TORO", {"pose": "VERTEX2"}, {"relative_pose": "EDGE2"}, fix=False)
ENDINGS = {".toro": TORO, ".graph": TORO}
"""How the names of files end that are not written as g2o."""
