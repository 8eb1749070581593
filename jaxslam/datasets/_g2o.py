"""Reader and writer of graphs as files of g2o and TORO."""

import gzip
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxslam.core._units import TURN, are_headings_in_degrees
from jaxslam.core.validation import InvalidField, instance_of, refusals_of, require
from jaxslam.datasets._lines import TextFile
from jaxslam.graphs._checks import check_numbers, is_indefinite
from jaxslam.graphs._factor import REGISTRY
from jaxslam.graphs._graph import Graph, Table
from jaxslam.graphs.starts import odometry
from jaxslam.results._files import write_files


class _Edge(NamedTuple):
    """The fields of one kind of edge."""

    table: str
    who: tuple[str, ...]
    """kinds of the variables, "pose" or "point" """
    measured: tuple[str, ...]
    entries: tuple[tuple[int, int], ...]
    """row and column in Ω of each number"""


# The order in which the formats write the entries of Ω.
_BY_ROWS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_TORO_ORDER = ((0, 0), (0, 1), (1, 1), (2, 2), (0, 2), (1, 2))
_POSE = ("x", "y", "theta")
EDGES = {
    "EDGE_SE2": _Edge("relative_pose", ("pose", "pose"), _POSE, _BY_ROWS),
    "EDGE2": _Edge("relative_pose", ("pose", "pose"), _POSE, _TORO_ORDER),
    "EDGE": _Edge("relative_pose", ("pose", "pose"), _POSE, _TORO_ORDER),
    "EDGE_PRIOR_SE2": _Edge("prior", ("pose",), _POSE, _BY_ROWS),
    "EDGE_SE2_XY": _Edge(
        "relative_position", ("pose", "point"), ("x", "y"), ((0, 0), (0, 1), (1, 1))
    ),
    "EDGE_BEARING_SE2_XY": _Edge("bearing", ("pose", "point"), ("bearing",), ((0, 0),)),
}
_VERTICES = {
    "VERTEX_SE2": ("pose", _POSE),
    "VERTEX2": ("pose", _POSE),
    "VERTEX": ("pose", _POSE),
    "VERTEX_XY": ("point", ("x", "y")),
}
_SKIPPED = {
    "ROBOTLASER1": "laser scans",
    "PARAMS_SE2OFFSET": "sensor offsets",  # no edge of EDGES refers to one
    "VERTEX_TAG": "notes",
    "VERTEX_ELLIPSE": "notes",
}
"""Lines that are not part of the graph, and the name under which they are counted."""


class Format(NamedTuple):
    """The kinds of lines of a file format."""

    name: str
    vertices: dict[str, str]
    """the kind of line of "pose" and "point" """
    edges: dict[str, str]
    """the kind of line of each table"""
    fix: bool
    """whether a variable can be fixed"""


_G2O = Format(
    "g2o",
    {"pose": "VERTEX_SE2", "point": "VERTEX_XY"},
    {edge.table: kind for kind, edge in EDGES.items() if edge.entries != _TORO_ORDER},
    fix=True,
)
TORO = Format("TORO", {"pose": "VERTEX2"}, {"relative_pose": "EDGE2"}, fix=False)
_ENDINGS = {".toro": TORO, ".graph": TORO}
"""Endings of file names that are not written as g2o."""


_LARGEST = 2**31 - 1
"""The largest id: ids are int32."""


class Loaded(NamedTuple):
    """The graph in a file, and the changes made to it."""

    graph: Graph
    skipped: dict[str, int]
    """number of lines that are not in the graph, by kind"""
    placed: int
    """number of poses and points without a line, placed along the edges"""

    @property
    def notes(self) -> tuple[str, ...]:
        """Signs that angles are in degrees, one sentence each."""
        notes = [
            f"{int(beyond.sum()):,} of {len(angle):,} angles of {key} are beyond 2π, up to "
            f"{np.abs(angle).max():.6g}: degrees? write radians"
            for key, table in self.graph.tables.items()
            for angle in (table.z[:, -1],)
            if key != "relative_position" and (beyond := np.abs(angle) > TURN).any()
        ]
        if not self.placed and are_headings_in_degrees(np.asarray(self.graph.poses)):
            notes.append(
                "headings of the poses contradict the directions between successive positions, "
                "which fit them as degrees: write radians"
            )
        return tuple(notes)


class _Row(NamedTuple):
    """The line of an edge."""

    line: int
    edge: _Edge
    ids: list[int]
    numbers: list[float]


def read_graph(path: str | Path) -> Graph:
    """The graph in a file of g2o or TORO, packed by gzip or not; arrays are NumPy's, of float64.

    The lines, their fields, and where they are in the graph:

        VERTEX_SE2           id x y θ                                  poses
        VERTEX2, VERTEX      id x y θ                                  poses (TORO)
        VERTEX_XY            id x y                                    points
        FIX                  ids                                       fixed_pose, fixed_point
        EDGE_SE2             i j x y θ I11 I12 I13 I22 I23 I33         relative_pose
        EDGE2, EDGE          a b f s r I_ff I_fs I_ss I_rr I_fr I_sr   relative_pose (TORO)
        EDGE_PRIOR_SE2       i x y θ, and Ω as EDGE_SE2 has it         prior
        EDGE_SE2_XY          i l x y I11 I12 I22                       relative_position
        EDGE_BEARING_SE2_XY  i l bearing I11                           bearing

    Poses and points are in the order of the file; the last five name tables. A line `EQUIV i j` of
    TORO makes two vertices one: that of the smaller id stays with its pose, or that of the vertex
    that is fixed, and has the edges of both, but for edges between them, which are left out.
    Numbers are those of the file. Comments (`#`), scans (`ROBOTLASER1`), notes (`VERTEX_TAG`,
    `VERTEX_ELLIPSE`) and offsets of sensors (`PARAMS_SE2OFFSET`, to which no edge that is read
    refers) are skipped; the command `jaxslam optimize` counts them. In a file without vertices,
    poses and points have the order of their ids and are placed along the edges, `starts.odometry`.
    The cost of the graph is χ² = Σ eᵀ Ω e, with e from `graphs.REGISTRY` and without a factor ½.

    Kümmerle et al. 2011, "g2o: A general framework for graph optimization", ICRA; Grisetti et al.
    2007, "A tree parameterization for efficiently computing maximum likelihood maps using gradient
    descent", RSS (TORO).

    Raises:
        ValueError: `path:line: reason` for an unknown or malformed line, a vertex that occurs
            twice, an edge to a missing vertex or from one to itself, an information that is not
            positive semidefinite, and equal vertices that are missing, or a pose and a point.
    """
    return load(path).graph


def load(path: str | Path) -> Loaded:
    """The graph in a file, as of `read_graph`, and the changes made to it."""
    file = TextFile(path)
    vertices: dict[str, dict[int, list[float]]] = {"pose": {}, "point": {}}
    rows: dict[str, list[_Row]] = {}
    fixed: list[tuple[int, int]] = []
    equal: list[tuple[int, ...]] = []
    skipped: dict[str, int] = {}
    for line, (kind, *fields) in file:
        if kind in EDGES:
            rows.setdefault(EDGES[kind].table, []).append(_row(file, line, EDGES[kind], fields))
        elif kind in _VERTICES:
            variable, names = _VERTICES[kind]
            file.expect(line, fields, ("id", *names))
            vertex = _identity(file, line, fields[0], "id")
            if any(vertex in named for named in vertices.values()):
                raise file.error(line, f"vertex {vertex} occurs twice")
            vertices[variable][vertex] = file.numbers(line, fields[1:], names)
        elif kind == "FIX":
            if not fields:
                raise file.error(line, "expected at least 1 field (id), got 0")
            fixed += [(line, _identity(file, line, field, "id")) for field in fields]
        elif kind == "EQUIV":
            file.expect(line, fields, ("i", "j"))
            equal.append((line, *(_identity(file, line, field, "id") for field in fields)))
        elif kind in _SKIPPED or kind.startswith("#"):
            label = _SKIPPED.get(kind, "comments")
            skipped[label] = skipped.get(label, 0) + 1
        else:
            kinds = ", ".join([*_VERTICES, "FIX", "EQUIV", *EDGES])
            raise file.error(line, f"unknown kind {kind!r}; known: {kinds}")
    if not rows:
        raise file.end_error("no edge in the file")
    if equal:
        rows, fixed, merged = _merge(file, vertices, rows, fixed, equal)
        skipped |= merged
        if not rows:
            raise file.end_error("no edge is left: all are within vertices that EQUIV merges")
    unplaced = not any(vertices.values())
    if unplaced:
        vertices = _vertices_of_edges(file, rows)
    graph = _assemble(file, vertices, rows, fixed)
    if not unplaced:
        return Loaded(graph, skipped, 0)
    try:
        return Loaded(odometry(graph), skipped, len(graph.poses) + len(graph.points))
    except ValueError as problem:
        raise file.end_error(f"no vertices in the file to start from: {problem}") from problem


def _identity(file: TextFile, line: int, field: str, name: str) -> int:
    """A field as an id; raises ValueError on another text, and on one above `_LARGEST`."""
    identity = file.identity(line, field, name)
    if identity > _LARGEST:
        raise file.error(line, f"{name} is above {_LARGEST}: {field}")
    return identity


def _row(file: TextFile, line: int, edge: _Edge, fields: list[str]) -> _Row:
    """The row of an edge; raises ValueError on a malformed line."""
    names = (*"ij"[: len(edge.who)], *edge.measured, *(f"I{i + 1}{j + 1}" for i, j in edge.entries))
    file.expect(line, fields, names)
    count = len(edge.who)
    ids = [_identity(file, line, field, n) for field, n in zip(fields[:count], names, strict=False)]
    if len(set(ids)) < count:
        raise file.error(line, f"an edge from vertex {ids[0]} to itself")
    return _Row(line, edge, ids, file.numbers(line, fields[count:], names[count:]))


def _merge(
    file: TextFile,
    vertices: dict[str, dict[int, list[float]]],
    rows: dict[str, list[_Row]],
    fixed: list[tuple[int, int]],
    equal: list[tuple[int, ...]],
) -> tuple[dict[str, list[_Row]], list[tuple[int, int]], dict[str, int]]:
    """The rows and the fixed vertices of a file in which lines EQUIV i j make vertices one.

    Of vertices that are equal, through any number of lines, the one with the smallest id stays with
    its pose, or with that of one that is fixed; the others leave `vertices`. An edge within them is
    left out. Also the counts. Raises ValueError on a vertex that is not in the file, on a pose that
    equals a point, and on equal vertices that are fixed at two places.
    """
    kinds = {vertex: kind for kind, named in vertices.items() for vertex in named}
    named = set(kinds) or {vertex for table in rows.values() for row in table for vertex in row.ids}
    parent: dict[int, int] = {}

    def smallest(vertex: int) -> int:
        """The root of a vertex in the union-find forest, whose paths are halved on the way."""
        while (above := parent.get(vertex, vertex)) != vertex:
            parent[vertex] = vertex = parent.get(above, above)
        return vertex

    for line, i, j in equal:
        for vertex in (i, j):
            if vertex not in named:
                raise file.error(line, f"vertex {vertex} is not defined in the file")
        if kinds.get(i) != kinds.get(j):
            raise file.error(line, f"one of the vertices {i} and {j} is a pose, the other a point")
        low, high = sorted((smallest(i), smallest(j)))
        if low != high:
            parent[high] = low
    held: dict[int, int] = {}
    for line, vertex in fixed:
        kept_id = smallest(vertex)
        if (kind := kinds.get(vertex)) is None:
            continue  # `_assemble` says so
        named_pose = vertices[kind][vertex]
        if vertices[kind][held.setdefault(kept_id, vertex)] != named_pose:
            raise file.error(
                line, f"vertices {held[kept_id]} and {vertex} are equal, and fixed at two places"
            )
    for kept_id, vertex in held.items():
        vertices[kinds[kept_id]][kept_id] = vertices[kinds[vertex]][vertex]
    for vertex in parent:
        if vertex in kinds:
            del vertices[kinds[vertex]][vertex]
    kept: dict[str, list[_Row]] = {}
    within = 0
    for key, table in rows.items():
        moved = [row._replace(ids=[smallest(vertex) for vertex in row.ids]) for row in table]
        kept[key] = [row for row in moved if len(set(row.ids)) == len(row.ids)]
        within += len(moved) - len(kept[key])
    counts = {
        "equivalences": len(equal),
        "vertices merged into another": len(parent),
        "edges within merged vertices": within,
    }
    return (
        {key: table for key, table in kept.items() if table},
        [(line, smallest(vertex)) for line, vertex in fixed],
        {label: count for label, count in counts.items() if count},
    )


def _vertices_of_edges(
    file: TextFile, rows: dict[str, list[_Row]]
) -> dict[str, dict[int, list[float]]]:
    """The vertices that edges name, at the origin, in the order of their ids."""
    kinds: dict[int, str] = {}
    for row in (row for table in rows.values() for row in table):
        for vertex, kind in zip(row.ids, row.edge.who, strict=True):
            if kinds.setdefault(vertex, kind) != kind:
                raise file.error(
                    row.line, f"vertex {vertex} is a pose in one edge, a point in another"
                )
    return {
        kind: {vertex: [0.0] * size for vertex in sorted(kinds) if kinds[vertex] == kind}
        for kind, size in (("pose", 3), ("point", 2))
    }


def _assemble(
    file: TextFile,
    vertices: dict[str, dict[int, list[float]]],
    rows: dict[str, list[_Row]],
    fixed: list[tuple[int, int]],
) -> Graph:
    """The graph of the lines of a file; ValueError if they do not fit together."""
    index = {
        kind: {vertex: at for at, vertex in enumerate(named)} for kind, named in vertices.items()
    }
    held = {kind: np.zeros(len(named), bool) for kind, named in vertices.items()}
    for line, vertex in fixed:
        kind = next((kind for kind, named in index.items() if vertex in named), None)
        if kind is None:
            raise file.error(line, f"vertex {vertex} is not defined in the file")
        held[kind][index[kind][vertex]] = True
    return Graph(
        poses=np.array(list(vertices["pose"].values())).reshape(-1, 3),
        points=np.array(list(vertices["point"].values())).reshape(-1, 2),
        tables={key: _table(file, table, index) for key, table in rows.items()},
        fixed_pose=held["pose"],
        fixed_point=held["point"],
        pose_id=np.array(list(vertices["pose"]), np.int32),
        point_id=np.array(list(vertices["point"]), np.int32),
    )


def _table(file: TextFile, rows: list[_Row], index: dict[str, dict[int, int]]) -> Table:
    """A table; ValueError on an undefined vertex, and on an indefinite information."""
    who, size = [], len(rows[0].edge.measured)
    information = np.zeros((len(rows), size, size))
    for row, matrix in zip(rows, information, strict=True):
        for vertex, kind in zip(row.ids, row.edge.who, strict=True):
            if vertex not in index[kind]:
                elsewhere = any(vertex in named for named in index.values())
                why = f"is not a {kind}" if elsewhere else "is not defined in the file"
                raise file.error(row.line, f"vertex {vertex} {why}")
        who.append([index[kind][v] for v, kind in zip(row.ids, row.edge.who, strict=True)])
        for (i, j), entry in zip(row.edge.entries, row.numbers[size:], strict=True):
            matrix[i, j] = matrix[j, i] = entry
    bad = is_indefinite(information)
    if bad.any():
        why = "the information is not positive semidefinite"
        if size == 3:
            why += "; EDGE2 has the order I11 I12 I22 I33 I13 I23, EDGE_SE2 that of the rows"
        raise file.error(rows[int(bad.argmax())].line, why)
    z = np.array([row.numbers[:size] for row in rows])
    return Table(np.array(who, np.int32), z, information, np.ones(len(rows), bool))


def write_graph(path: str | Path, graph: Graph) -> None:
    """Write a graph as a file that `read_graph` reads as the same graph, number by number.

    The format is g2o; in a file that ends in .toro or .graph it is TORO, which has lines for poses
    and relative poses. A file that ends in .gz, after that, is packed by gzip.

    Poses, points, the tables in their order, then `FIX`, at which GTSAM's reader stops. Rows that
    are not valid are left out. A table "name/part" is written as the table "name", and read as
    part of it.

    Raises:
        ValueError: before anything is written, on data without a line in the format: in TORO
            points, fixed poses, and tables other than relative poses; in g2o tables that
            `read_graph` does not name and points of other than two numbers. In both on an id of
            both a pose and a point, and on what `read_graph` refuses: ids twice or below zero,
            numbers that are not finite, and informations that are not symmetric and positive
            semidefinite.
    """
    with refusals_of("write_graph"):
        require("graph", graph, instance_of(Graph))
    path = Path(path)
    packed = path.suffix == ".gz"
    ending = path.with_suffix("").suffix if packed else path.suffix
    text = text_of(graph, _ENDINGS.get(ending, _G2O))
    ids = np.concatenate([np.asarray(graph.pose_id), np.asarray(graph.point_id)])
    factors = {key: REGISTRY[key.split("/")[0]] for key in graph.tables}
    with refusals_of("write_graph"):
        if (ids < 0).any():
            raise InvalidField("graph", f"expected ids >= 0, got {ids.min()}")
        check_numbers(graph, factors)

    # Without the time, so that equal graphs give equal files.
    content = gzip.compress(text.encode("utf-8"), mtime=0) if packed else text
    write_files(path.parent, {path.name: content})


def text_of(graph: Graph, form: Format = _G2O) -> str:
    """The text of a graph in a format; raises InvalidField as `write_graph` does."""
    with refusals_of("write_graph"):
        _check_writable(graph, form)
    ids = {"pose": np.asarray(graph.pose_id), "point": np.asarray(graph.point_id)}
    values = {"pose": np.asarray(graph.poses), "point": np.asarray(graph.points)}
    held = {"pose": np.asarray(graph.fixed_pose), "point": np.asarray(graph.fixed_point)}
    lines = [
        _line(name, [vertex], row)
        for kind, name in form.vertices.items()
        for vertex, row in zip(ids[kind], values[kind], strict=True)
    ]
    for key, table in graph.tables.items():
        name = form.edges[key.split("/")[0]]
        edge = EDGES[name]
        valid = np.asarray(table.valid)
        information = np.asarray(table.information)[valid]
        entries = np.stack([information[:, i, j] for i, j in edge.entries], axis=1)
        numbers = np.concatenate([np.asarray(table.z)[valid], entries], axis=1)
        who = np.asarray(table.who)[valid]
        names = np.stack([ids[kind][who[:, k]] for k, kind in enumerate(edge.who)], axis=1)
        lines += [_line(name, *row) for row in zip(names, numbers, strict=True)]
    # Last: GTSAM's readG2o stops at a line that does not begin with two numbers, as `FIX 0` does.
    lines += [f"FIX {vertex}" for kind in form.vertices for vertex in ids[kind][held[kind]]]
    return "\n".join(lines) + "\n"


def _check_writable(graph: Graph, form: Format) -> None:
    """Raise InvalidField on a graph that the format cannot represent."""
    if len(both := np.intersect1d(graph.pose_id, graph.point_id)):
        raise InvalidField(
            "graph",
            f"{both[0]} is the id of a pose and of a point, which {form.name} does not allow",
        )
    if len(graph.points) and "point" not in form.vertices:
        count = len(graph.points)
        raise InvalidField("graph", f"{form.name} has no line for points, and it has {count}")
    if len(graph.points) and graph.points.shape[1] != 2:
        size = graph.points.shape[1]
        raise InvalidField("graph", f"expected points (x, y), got {size} numbers")
    held = np.asarray(graph.pose_id)[np.asarray(graph.fixed_pose)]
    if len(held) and not form.fix:
        reason = f"{form.name} has no line for fixed poses, and pose {held[0]} is fixed"
        raise InvalidField("graph", reason)
    for key in graph.tables:
        if key.split("/")[0] not in form.edges:
            raise InvalidField(
                "graph",
                f"{form.name} has no line for table {key!r}; it has some for "
                f"{', '.join(form.edges)}",
            )


def _line(kind: str, ids: Sequence[int], numbers: np.ndarray) -> str:
    """A line of a file; `repr` of a float64 is read as the same number."""
    return " ".join([kind, *map(str, ids), *map(repr, np.asarray(numbers, float).tolist())])
