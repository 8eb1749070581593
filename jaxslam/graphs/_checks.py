"""Checks of a graph before it is solved; each error is a line that names the row or variable."""

from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy  # its parts load where they are used
from jaxtyping import Bool, Float, Int

from jaxslam.core._numbers import is_concrete
from jaxslam.core.types import JaxOrNumPy
from jaxslam.graphs._factor import Factor
from jaxslam.graphs._graph import Graph, Table
from jaxslam.graphs._solver.model import factors_of
from jaxslam.math import _definite as definite

_DIGITS = 1e-6
"""The rounding of an information, with a unit diagonal and next to its largest entry: files have
about six digits."""


class Parts(NamedTuple):
    """The connected parts of a graph; variables are the N poses, then the P points."""

    part: Int[np.ndarray, "V"]
    """the part of each variable, from 0"""
    anchored: Bool[np.ndarray, "parts"]
    """whether a part has a gauge: a fixed pose, two fixed points or a measurement of one pose
    alone"""
    free: Bool[np.ndarray, "parts"]
    """whether a part has a variable that is not fixed, and so needs a gauge"""


def check_graph(name: str, graph: Graph, factors: Mapping[str, Factor]) -> None:
    """Raise ValueError, which begins with a caller's name, unless a graph can be solved.

    Refused are tables without a factor or of other sizes than their factor's, arrays of another
    kind than `Graph` and `Table` say, numbers that are not finite, an id twice, a measurement of a
    variable out of range or of one variable twice, an information that is not symmetric or not
    positive semidefinite, no measurement at all, and parts that neither a fixed variable nor a
    measurement of one pose holds in place: a disconnected graph, or no gauge. A measurement of zero
    information joins nothing. Within a trace only shapes are checked.
    """
    _check_shapes(name, graph)
    for key, table in graph.tables.items():
        if key not in factors:
            raise ValueError(
                f"{name}: table {key!r} has no factor; there are: {', '.join(factors) or 'none'}"
            )
        prefix, factor = f"{name}: table {key!r}", factors[key]
        rows = np.shape(table.who)[0]
        k, z, r = (len(part) for part in (factor.variables, factor.measurements, factor.errors))
        wanted = {"who": (rows, k), "z": (rows, z), "information": (rows, r, r), "valid": (rows,)}
        for field, shape in wanted.items():
            if (got := np.shape(getattr(table, field))) != shape:
                raise ValueError(f"{prefix}: expected {field} of shape {shape}, got {got}")
        _check_kind(prefix, who=(table.who, np.integer), valid=(table.valid, np.bool_))
    if not is_concrete(graph):
        return
    check_numbers(name, graph, factors)
    if not any(np.asarray(table.valid).any() for table in graph.tables.values()):
        raise ValueError(f"{name}: the graph has no measurement")
    _check_gauge(name, graph, factors)


def check_numbers(name: str, graph: Graph, factors: Mapping[str, Factor]) -> None:
    """Raise ValueError on variables and rows of a concrete graph that `check_graph` refuses.

    The gauge is not checked.
    """
    kinds = (("pose", graph.poses, graph.pose_id), ("point", graph.points, graph.point_id))
    for kind, values, ids in kinds:
        ids = np.asarray(ids)
        bad = ~np.isfinite(np.asarray(values)).all(axis=1)
        if bad.any():
            raise ValueError(f"{name}: {kind} {ids[bad.argmax()]} is not finite")
        unique, count = np.unique(ids, return_counts=True)
        if (count > 1).any():
            raise ValueError(f"{name}: {kind} {unique[count.argmax()]} occurs twice")
    for key, table in graph.tables.items():
        _check_rows(name, graph, key, table, factors[key])


def _parts_of(graph: Graph, factors: Mapping[str, Factor]) -> Parts:
    """The connected parts of a graph, and whether each has a gauge.

    A row whose information is zero neither joins its variables nor holds one.
    """
    poses, points = len(graph.poses), len(graph.points)
    pairs = [np.zeros((0, 2), int)]
    held = np.asarray(graph.fixed_pose).copy()
    for key, table in graph.tables.items():
        counted = np.asarray(table.valid) & np.asarray(table.information).any(axis=(1, 2))
        who = variables_in(graph, table._replace(valid=counted), factors[key])
        pairs += [who[:, [0, k]] for k in range(1, who.shape[1])]
        if factors[key].variables == ("pose",):
            held[who[:, 0]] = True
    first, second = np.concatenate(pairs).T
    joined = scipy.sparse.coo_array(
        (np.ones(len(first)), (first, second)), shape=(poses + points,) * 2
    )
    count, part = scipy.sparse.csgraph.connected_components(joined, directed=False)
    anchored = np.bincount(part[:poses], held, minlength=count) > 0
    fixed = np.bincount(part[poses:], np.asarray(graph.fixed_point), minlength=count)
    loose = np.concatenate([~np.asarray(graph.fixed_pose), ~np.asarray(graph.fixed_point)])
    free = np.bincount(part, loose, minlength=count) > 0
    return Parts(part, anchored | (fixed > 1), free)


def variables_in(graph: Graph, table: Table, factor: Factor) -> Int[np.ndarray, "rows K"]:
    """The variables of the valid rows of a table, points counted on from the poses."""
    shift = [0 if kind == "pose" else len(graph.poses) for kind in factor.variables]
    return np.asarray(np.asarray(table.who)[np.asarray(table.valid)] + np.array(shift, int))


def is_indefinite(information: Float[np.ndarray, "E R R"]) -> Bool[np.ndarray, "E"]:
    """Whether each information is not positive semidefinite, beyond the rounding of a file."""
    return definite.indefinite(information, _DIGITS, _DIGITS)


def label(graph: Graph, variable: int) -> str:
    """The kind and id of a variable, counted as in `Parts`: "pose 7"."""
    poses = len(graph.poses)
    if variable < poses:
        return f"pose {int(graph.pose_id[variable])}"
    return f"point {int(graph.point_id[variable - poses])}"


def _check_kind(prefix: str, **values: tuple[JaxOrNumPy, type]) -> None:
    """Raise ValueError, which begins with a prefix, on arrays of another kind of number.

    An array without entries may be of any kind.
    """
    for field, (value, kind) in values.items():
        if not hasattr(value, "dtype"):
            raise ValueError(
                f"{prefix}: expected {field} to be an array, got {type(value).__name__}"
            )
        if np.size(value) and not jnp.issubdtype(value.dtype, kind):
            expected = "bool" if kind is np.bool_ else "integers"
            raise ValueError(f"{prefix}: expected {field} of {expected}, got {value.dtype}")


def _check_shapes(name: str, graph: Graph) -> None:
    """Raise ValueError on poses and points of other shapes and kinds than `Graph` says."""
    poses, points = np.shape(graph.poses), np.shape(graph.points)
    if len(poses) != 2 or poses[1] != 3 or len(points) != 2:
        raise ValueError(f"{name}: expected poses (N, 3) and points (P, L), got {poses}, {points}")
    for field, count in (
        ("pose_id", poses[0]),
        ("fixed_pose", poses[0]),
        ("point_id", points[0]),
        ("fixed_point", points[0]),
    ):
        if (got := np.shape(getattr(graph, field))) != (count,):
            raise ValueError(f"{name}: expected {field} of shape ({count},), got {got}")
    _check_kind(
        name,
        fixed_pose=(graph.fixed_pose, np.bool_),
        fixed_point=(graph.fixed_point, np.bool_),
        pose_id=(graph.pose_id, np.integer),
        point_id=(graph.point_id, np.integer),
    )


def _check_rows(name: str, graph: Graph, key: str, table: Table, factor: Factor) -> None:
    """Raise ValueError on the first bad row of a table."""
    valid, who = np.asarray(table.valid), np.asarray(table.who)
    z, information = np.asarray(table.z), np.asarray(table.information)
    for k, kind in enumerate(factor.variables):
        count = len(graph.poses if kind == "pose" else graph.points)
        lost = valid & ((who[:, k] < 0) | (who[:, k] >= count))
        if lost.any():
            row = int(lost.argmax())
            raise ValueError(
                f"{name}: {key}, row {row}: {kind} index {who[row, k]} is out of "
                f"range: the graph has {count} {kind}s"
            )
    variables = np.sort(variables_in(graph, table, factor), axis=1)
    twice = np.zeros(len(valid), bool)
    twice[valid] = (variables[:, 1:] == variables[:, :-1]).any(axis=1)
    finite = np.isfinite(information).all(axis=(1, 2))
    clean = np.where(finite[:, None, None], information, 0.0)
    for bad, why in (
        (twice, "joins a variable to itself"),
        (~np.isfinite(z).all(axis=1), "z is not finite"),
        (~finite, "the information is not finite"),
        (definite.asymmetric(clean, _DIGITS), "the information is not symmetric"),
        (is_indefinite(clean), "the information is not positive semidefinite"),
    ):
        if (bad & valid).any():
            row = int((bad & valid).argmax())
            alone = table._replace(valid=np.arange(len(valid)) == row)
            involved = variables_in(graph, alone, factor)[0]
            between = ", ".join(label(graph, int(variable)) for variable in involved)
            raise ValueError(f"{name}: {key}, row {row} ({between}): {why}")


def _check_gauge(name: str, graph: Graph, factors: Mapping[str, Factor]) -> None:
    """Raise ValueError on a part of a graph that nothing holds in place."""
    parts = _parts_of(graph, factors)
    loose = np.flatnonzero(~parts.anchored & parts.free)
    if not len(loose):
        return
    members = np.flatnonzero(parts.part == loose[0])
    labels = ", ".join(label(graph, int(variable)) for variable in members[:3])
    labels += f", … ({len(members):,} variables)" if len(members) > 3 else ""
    if parts.free.sum() == 1 and not parts.anchored.any():
        raise ValueError(
            f"{name}: the graph has no gauge: fix a pose (`graphs.with_gauge` fixes the first) or "
            "give one a prior"
        )
    count = int((parts.free | parts.anchored).sum())
    raise ValueError(
        f"{name}: the graph is disconnected: no measurement with information joins {labels} to a "
        f"fixed pose or one with a prior; {count} parts, {len(loose)} of them loose"
    )


def with_gauge(graph: Graph, factors: Mapping[str, Factor] | None = None) -> Graph:
    """The graph with a pose fixed, if no variable is and no measurement is of one pose alone.

    It is the pose of the lowest id, in the largest part where the graph is disconnected. A graph
    that has a gauge is returned as it is: the same object.
    """
    parts = _parts_of(graph, factors_of("graphs.with_gauge", graph, factors))
    if not len(graph.poses) or parts.anchored.any():
        return graph
    fixed = np.asarray(graph.fixed_pose).copy()
    by_id = np.argsort(np.asarray(graph.pose_id), kind="stable")
    part = parts.part[by_id]
    fixed[by_id[np.bincount(part)[part].argmax()]] = True
    return graph._replace(fixed_pose=fixed)
