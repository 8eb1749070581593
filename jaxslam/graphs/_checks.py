"""Checks of a graph before it is solved; each error is a line that names the row or variable."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import scipy  # its parts load where they are used
from jaxtyping import Bool, Float, Int

from jaxslam.core._numbers import is_concrete
from jaxslam.core.validation import Check, InvalidField, array_of, refusals_of, require
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


def check_graph(graph: Graph, factors: Mapping[str, Factor]) -> None:
    """Raise InvalidField unless a graph can be solved.

    Refused are tables without a factor or of other sizes than their factor's, arrays of another
    kind than `Graph` and `Table` say, numbers that are not finite, an id twice, a measurement of a
    variable out of range or of one variable twice, an information that is not symmetric or not
    positive semidefinite, no measurement at all, and parts that neither a fixed variable nor a
    measurement of one pose holds in place: a disconnected graph, or no gauge. A measurement of zero
    information joins nothing. Within a trace only shapes are checked.
    """
    require("poses", graph.poses, array_of("N", 3))
    require("points", graph.points, array_of("P", "L"))
    poses, points = len(graph.poses), len(graph.points)
    require("pose_id", graph.pose_id, _entries(np.integer, poses))
    require("point_id", graph.point_id, _entries(np.integer, points))
    require("fixed_pose", graph.fixed_pose, _entries(np.bool_, poses))
    require("fixed_point", graph.fixed_point, _entries(np.bool_, points))
    for key, table in graph.tables.items():
        if key not in factors:
            raise InvalidField(
                "factors", f"table {key!r} has no factor; there are: {', '.join(factors) or 'none'}"
            )
        place, factor = f"table {key!r}", factors[key]
        rows = np.shape(table.who)[0]
        k, z, r = (len(part) for part in (factor.variables, factor.measurements, factor.errors))
        require(f"{place}: who", table.who, _entries(np.integer, rows, k))
        require(f"{place}: z", table.z, array_of(rows, z))
        require(f"{place}: information", table.information, array_of(rows, r, r))
        require(f"{place}: valid", table.valid, _entries(np.bool_, rows))
    if not is_concrete(graph):
        return
    check_numbers(graph, factors)
    if not any(np.asarray(table.valid).any() for table in graph.tables.values()):
        raise InvalidField("", "the graph has no measurement")

    # Each part has a gauge, which holds it in place.
    parts = _parts_of(graph, factors)
    loose = np.flatnonzero(~parts.anchored & parts.free)
    if not len(loose):
        return
    members = np.flatnonzero(parts.part == loose[0])
    labels = ", ".join(label(graph, int(variable)) for variable in members[:3])
    labels += f", … ({len(members):,} variables)" if len(members) > 3 else ""
    if parts.free.sum() == 1 and not parts.anchored.any():
        raise InvalidField(
            "",
            "the graph has no gauge: fix a pose (`graphs.with_gauge` fixes the first) or "
            "give one a prior",
        )
    count = int((parts.free | parts.anchored).sum())
    raise InvalidField(
        "",
        f"the graph is disconnected: no measurement with information joins {labels} to a "
        f"fixed pose or one with a prior; {count} parts, {len(loose)} of them loose",
    )


def check_numbers(graph: Graph, factors: Mapping[str, Factor]) -> None:
    """Raise InvalidField on variables and rows of a concrete graph that `check_graph` refuses.

    The gauge is not checked.
    """
    kinds = (("pose", graph.poses, graph.pose_id), ("point", graph.points, graph.point_id))
    for kind, values, ids in kinds:
        ids = np.asarray(ids)
        bad = ~np.isfinite(np.asarray(values)).all(axis=1)
        if bad.any():
            raise InvalidField("", f"{kind} {ids[bad.argmax()]} is not finite")
        unique, count = np.unique(ids, return_counts=True)
        if (count > 1).any():
            raise InvalidField("", f"{kind} {unique[count.argmax()]} occurs twice")
    for key in graph.tables:
        _check_rows(graph, key, factors[key])


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
    return definite.is_indefinite(information, _DIGITS, _DIGITS)


def label(graph: Graph, variable: int) -> str:
    """The kind and id of a variable, counted as in `Parts`: "pose 7"."""
    poses = len(graph.poses)
    if variable < poses:
        return f"pose {int(graph.pose_id[variable])}"
    return f"point {int(graph.point_id[variable - poses])}"


def _entries(kind: type, *shape: int) -> Check:
    """The check of an array of a shape and kind; one without entries may be of any kind."""
    return lambda value: array_of(*shape, kind=kind if np.size(value) else np.generic)(value)


def _check_rows(graph: Graph, key: str, factor: Factor) -> None:
    """Raise InvalidField on the first bad row of a table."""
    table = graph.tables[key]
    valid, who = np.asarray(table.valid), np.asarray(table.who)
    z, information = np.asarray(table.z), np.asarray(table.information)
    for k, kind in enumerate(factor.variables):
        count = len(graph.poses if kind == "pose" else graph.points)
        lost = valid & ((who[:, k] < 0) | (who[:, k] >= count))
        if lost.any():
            row = int(lost.argmax())
            raise InvalidField(
                f"{key}, row {row}",
                f"{kind} index {who[row, k]} is out of range: the graph has {count} {kind}s",
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
        (definite.is_asymmetric(clean, _DIGITS), "the information is not symmetric"),
        (is_indefinite(clean), "the information is not positive semidefinite"),
    ):
        if (bad & valid).any():
            row = int((bad & valid).argmax())
            alone = table._replace(valid=np.arange(len(valid)) == row)
            involved = variables_in(graph, alone, factor)[0]
            between = ", ".join(label(graph, int(variable)) for variable in involved)
            raise InvalidField(f"{key}, row {row} ({between})", why)


def with_gauge(graph: Graph, factors: Mapping[str, Factor] | None = None) -> Graph:
    """The graph with a pose fixed, if no variable is and no measurement is of one pose alone.

    It is the pose of the lowest id, in the largest part where the graph is disconnected. A graph
    that has a gauge is returned as it is: the same object.
    """
    with refusals_of("graphs.with_gauge"):
        factors = factors_of(graph, factors)
    parts = _parts_of(graph, factors)
    if not len(graph.poses) or parts.anchored.any():
        return graph
    fixed = np.asarray(graph.fixed_pose).copy()
    by_id = np.argsort(np.asarray(graph.pose_id), kind="stable")
    part = parts.part[by_id]
    fixed[by_id[np.bincount(part)[part].argmax()]] = True
    return graph._replace(fixed_pose=fixed)
