"""Writer of pose and landmark graphs: g2o, and TORO by the ending of the file's name."""

import gzip
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxslam.datasets.formats.g2o.kinds import EDGES, ENDINGS, G2O, Format
from jaxslam.graphs.factor import REGISTRY
from jaxslam.graphs.graph import Graph
from jaxslam.graphs.validation import check_numbers
from jaxslam.results.files import write_files


def save(path: str | Path, graph: Graph) -> None:
    """Write a graph as a file of g2o, or TORO by the file's ending; see `graphs.write`."""
    path = Path(path)
    packed = path.suffix == ".gz"
    ending = path.with_suffix("").suffix if packed else path.suffix
    text = text_of(graph, ENDINGS.get(ending, G2O))
    _check_readable(graph)

    def pack(target: Path) -> None:
        target.write_bytes(gzip.compress(text.encode("utf-8"), mtime=0))

    write_files(path.parent, {path.name: pack if packed else text})


def text_of(graph: Graph, form: Format = G2O) -> str:
    """The graph in a format; raises ValueError as `graphs.write` does."""
    _check_writable(graph, form)
    ids = {"pose": np.asarray(graph.pose_id), "point": np.asarray(graph.point_id)}
    values = {"pose": np.asarray(graph.poses), "point": np.asarray(graph.points)}
    held = {"pose": np.asarray(graph.fixed_pose), "point": np.asarray(graph.fixed_point)}
    lines = [
        _line(name, [one], row)
        for kind, name in form.vertices.items()
        for one, row in zip(ids[kind], values[kind], strict=True)
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
    lines += [f"FIX {one}" for kind in form.vertices for one in ids[kind][held[kind]]]
    return "\n".join(lines) + "\n"


def _check_readable(graph: Graph) -> None:
    """Raise ValueError on what `read` refuses."""
    ids = np.concatenate([np.asarray(graph.pose_id), np.asarray(graph.point_id)])
    if (ids < 0).any():
        raise ValueError(f"graphs.write: expected ids >= 0, got {ids.min()}")
    known = {key: REGISTRY[key.split("/")[0]] for key in graph.tables}
    check_numbers("graphs.write", graph, known)


def _check_writable(graph: Graph, form: Format) -> None:
    """Raise ValueError on what a format has no line for."""
    if len(both := np.intersect1d(graph.pose_id, graph.point_id)):
        raise ValueError(
            f"graphs.write: {both[0]} is the id of a pose and of a point, which {form.name} does "
            "not allow"
        )
    if len(graph.points) and "point" not in form.vertices:
        raise ValueError(
            f"graphs.write: {form.name} has no line for points, and the graph has "
            f"{len(graph.points)}"
        )
    if len(graph.points) and graph.points.shape[1] != 2:
        raise ValueError(
            f"graphs.write: expected points (x, y), got {graph.points.shape[1]} numbers"
        )
    held = np.asarray(graph.pose_id)[np.asarray(graph.fixed_pose)]
    if len(held) and not form.fix:
        raise ValueError(
            f"graphs.write: {form.name} has no line for fixed poses, and pose {held[0]} is fixed"
        )
    for key in graph.tables:
        if key.split("/")[0] not in form.edges:
            raise ValueError(
                f"graphs.write: {form.name} has no line for table {key!r}; it has some for "
                f"{', '.join(form.edges)}"
            )


def _line(kind: str, ids: Sequence[int], numbers: np.ndarray) -> str:
    return " ".join([kind, *map(str, ids), *map(repr, np.asarray(numbers, float).tolist())])
