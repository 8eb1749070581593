"""The relative poses of all tables, the anchors of a graph, and the placing of its points."""

from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy  # its parts load where they are used
from jaxtyping import Bool, Float, Int

from jaxslam.core.types import JaxOrNumPy
from jaxslam.core.validation import InvalidField
from jaxslam.graphs._factor import BetweenPoses, Factor
from jaxslam.graphs._graph import Graph, ranks
from jaxslam.graphs._solver.model import factors_of
from jaxslam.math import se2

Factors = Mapping[str, Factor]


class Relative(NamedTuple):
    """The E relative poses that the tables of a graph measure."""

    first: Int[np.ndarray, "E"]
    second: Int[np.ndarray, "E"]
    pose: Float[np.ndarray, "E 3"]
    """the second in the frame of the first"""
    information: Float[np.ndarray, "E 3 3"]
    """Ω of the error e = pose⁻¹ ∘ (xᵢ⁻¹ ∘ xⱼ), to first order"""


def measured_relative_poses(graph: Graph, factors: Factors | None) -> Relative:
    """The relative poses that valid rows between two poses measure, of all tables, by id.

    A row of zero information measures none.
    """
    parts, by_table = [], factors_of(graph, factors)
    for key, table in graph.tables.items():
        factor = by_table[key]
        if factor.variables != ("pose", "pose") or factor.predict is None:
            continue
        valid = np.asarray(table.valid) & np.asarray(table.information).any(axis=(1, 2))
        who, z, information = (
            np.asarray(part)[valid] for part in (table.who, table.z, table.information)
        )
        if not isinstance(factor, BetweenPoses):
            z, by_error = map(np.asarray, _measured_poses(factor, z))
            # Jᵀ Ω J, J the derivative of the residual by the error of the relative pose.
            information = np.einsum("eri,ers,esj->eij", by_error, information, by_error)
        parts.append(
            Relative(who[:, 0], who[:, 1], np.asarray(z, float), np.asarray(information, float))
        )
    if not parts:
        return Relative(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    joined = Relative(*map(np.concatenate, zip(*parts, strict=True)))
    rows = _order_by_id(graph, np.stack(joined[:2], axis=1), joined.pose)
    return Relative(*(part[rows] for part in joined))


def _order_by_id(
    graph: Graph, who: Int[np.ndarray, "E K"], z: Float[np.ndarray, "E Z"]
) -> Int[np.ndarray, "E"]:
    """The rows in the order of the ids of their poses, then of |z|, then of z.

    The first row for a variable places it; so the place does not depend on the order in a file.
    """
    # `lexsort` takes the last key first: the id of the first pose.
    return np.lexsort((*z.T, np.linalg.norm(z, axis=1), *ranks(graph)[who].T[::-1]))


@partial(jax.jit, inline=True)
def _measured_poses(factor: Factor, z: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The relative poses of rows, and the derivatives of the residuals by their errors."""

    def measured_pose(z: jax.Array) -> tuple[jax.Array, jax.Array]:
        origin = jnp.zeros(3, z.dtype)
        assert factor.predict is not None
        relative = factor.predict(origin, z)

        def residual(error: jax.Array) -> jax.Array:
            return factor.residual((origin, se2.compose(relative, error)), z)

        return relative, jax.jacfwd(residual)(origin)

    return jax.vmap(measured_pose)(z)


def anchors_of(
    graph: Graph, relative: Relative
) -> tuple[Bool[np.ndarray, "N"], Float[np.ndarray, "N 3"]]:
    """Whether each pose is an anchor, which holds its part of the graph, and all poses, with the
    anchors where they are held.

    Raises InvalidField if a part has no anchor.
    """
    poses = np.array(graph.poses, np.float64)
    anchors = np.asarray(graph.fixed_pose).copy()
    count, lowest = len(poses), np.argmin(graph.pose_id) if len(poses) else 0
    joined = scipy.sparse.coo_array(
        (np.ones(len(relative.first)), (relative.first, relative.second)), shape=(count, count)
    )
    parts, part = scipy.sparse.csgraph.connected_components(joined, directed=False)
    held = np.bincount(part, anchors, minlength=parts) > 0
    if "prior" in graph.tables:
        table = graph.tables["prior"]
        who, priors = (np.asarray(part)[np.asarray(table.valid)] for part in (table.who, table.z))
        rows = _order_by_id(graph, who, priors)
        for (pose,), z in zip(who[rows], priors[rows], strict=True):
            if not held[part[pose]]:
                anchors[pose] = held[part[pose]] = True
                poses[pose] = z
    if not held.any() and count:
        anchors[lowest] = held[part[lowest]] = True
    if not held.all():
        lost = int(np.flatnonzero(~held[part])[0])
        reason = (
            f"pose {int(graph.pose_id[lost])} is not connected to a fixed pose by relative poses"
        )
        raise InvalidField("graph", reason)
    return anchors, poses


def with_poses(graph: Graph, poses: Float[np.ndarray, "N 3"]) -> Graph:
    """The graph at other poses, angles wrapped; fixed ones stay as they are, to the bit."""
    # In (-π, π]: `mod` gives [0, 2π).
    poses[:, 2] = np.pi - np.mod(np.pi - poses[:, 2], 2 * np.pi)
    fixed = np.asarray(graph.fixed_pose)
    poses[fixed] = np.asarray(graph.poses)[fixed]
    return graph._replace(poses=as_before(graph.poses, poses))


def as_before(before: JaxOrNumPy, values: np.ndarray) -> np.ndarray:
    """The values in the dtype of the former ones, unless that is an integer dtype."""
    dtype = np.asarray(before).dtype
    return values.astype(dtype) if np.issubdtype(dtype, np.floating) else values


def with_points(
    graph: Graph, factors: Factors | None, placed: Bool[np.ndarray, "P"] | None = None
) -> Graph:
    """The graph with each point placed by a measurement, from the pose of the lowest id with one.

    Points that are fixed or placed already stay, and so do points without a measurement that
    places them.
    """
    points = np.array(graph.points, np.float64)
    by_table = factors_of(graph, factors)
    placed_already = np.asarray(graph.fixed_point) | (False if placed is None else placed)
    for key, table in graph.tables.items():
        factor = by_table[key]
        if factor.variables != ("pose", "point") or factor.predict is None:
            continue
        who, z = (np.asarray(part)[np.asarray(table.valid)] for part in (table.who, table.z))
        rows = _order_by_id(graph, who[:, :1], z)
        who, z = who[rows], z[rows]
        point, first = np.unique(who[:, 1], return_index=True)
        first = first[~placed_already[point]]
        if len(first):
            poses = np.asarray(graph.poses)[who[first, 0]]
            points[who[first, 1]] = _predicted_points(factor, poses, z[first])
            placed_already[who[first, 1]] = True
    return graph._replace(points=as_before(graph.points, points))


@partial(jax.jit, inline=True)
def _predicted_points(factor: Factor, poses: jax.Array, z: jax.Array) -> jax.Array:
    """The points that rows measure from poses."""
    assert factor.predict is not None
    points: jax.Array = jax.vmap(factor.predict)(poses, z)
    return points
