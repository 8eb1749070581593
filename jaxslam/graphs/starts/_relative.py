"""What all starts share: relative poses of all tables, anchors, and the placing of points."""

from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy  # its parts load where they are used
from jaxtyping import Bool, Float, Int

from jaxslam.core.types import JaxOrNumPy
from jaxslam.graphs._factor import BetweenPoses, Factor
from jaxslam.graphs._graph import Graph, ranks
from jaxslam.graphs._solver.model import factors_of
from jaxslam.math import se2

Factors = Mapping[str, Factor]


class Relative(NamedTuple):
    """The relative poses of all tables between two poses, E of them."""

    first: Int[np.ndarray, "E"]
    second: Int[np.ndarray, "E"]
    pose: Float[np.ndarray, "E 3"]
    """the second in the frame of the first"""
    information: Float[np.ndarray, "E 3 3"]
    """of e = pose⁻¹ ∘ (xᵢ⁻¹ ∘ xⱼ), to first order"""


def measured_relative_poses(graph: Graph, factors: Factors | None) -> Relative:
    """The relative poses that valid rows between two poses measure, of all tables, by id.

    A row of zero information measures none.
    """
    found, known = [], factors_of("graphs.starts", graph, factors)
    for key, table in graph.tables.items():
        factor = known[key]
        if factor.variables != ("pose", "pose") or factor.predict is None:
            continue
        valid = np.asarray(table.valid) & np.asarray(table.information).any(axis=(1, 2))
        who, z, information = (
            np.asarray(part)[valid] for part in (table.who, table.z, table.information)
        )
        if not isinstance(factor, BetweenPoses):
            z, by_error = map(np.asarray, _measured_poses(factor, z))
            information = np.einsum("eri,ers,esj->eij", by_error, information, by_error)
        found.append(
            Relative(who[:, 0], who[:, 1], np.asarray(z, float), np.asarray(information, float))
        )
    nothing = Relative(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    if not found:
        return nothing
    every = Relative(*map(np.concatenate, zip(*found, strict=True)))
    rows = _by_id(graph, np.stack(every[:2], axis=1), every.pose)
    return Relative(*(part[rows] for part in every))


def _by_id(graph: Graph, who: Int[np.ndarray, "E K"], z: Float[np.ndarray, "E Z"]) -> np.ndarray:
    """The rows in the order of the ids of their poses, then of the size of what they measured.

    The first row for a variable places it; in this order that row does not depend on a file's.
    """
    return np.lexsort((*z.T, np.linalg.norm(z, axis=1), *ranks(graph)[who].T[::-1]))


@partial(jax.jit, inline=True)
def _measured_poses(factor: Factor, z: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The relative poses of rows, and the derivatives of the residual by an error of them."""

    def one(z: jax.Array) -> tuple[jax.Array, jax.Array]:
        origin = jnp.zeros(3, z.dtype)
        assert factor.predict is not None
        relative = factor.predict(origin, z)

        def residual(error: jax.Array) -> jax.Array:
            return factor.residual((origin, se2.compose(relative, error)), z)

        return relative, jax.jacfwd(residual)(origin)

    return jax.vmap(one)(z)


def anchors_of(
    name: str, graph: Graph, relative: Relative
) -> tuple[Bool[np.ndarray, "N"], Float[np.ndarray, "N 3"]]:
    """Which poses hold their part of the graph, and all poses, with those where they are held.

    Raises ValueError, which begins with the name of the start, if a part has none.
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
        rows = _by_id(graph, who, priors)
        for (pose,), z in zip(who[rows], priors[rows], strict=True):
            if not held[part[pose]]:
                anchors[pose] = held[part[pose]] = True
                poses[pose] = z
    if not held.any() and count:
        anchors[lowest] = held[part[lowest]] = True
    if not held.all():
        lost = int(np.flatnonzero(~held[part])[0])
        raise ValueError(
            f"{name}: pose {int(graph.pose_id[lost])} is not connected to a fixed pose by relative "
            "poses"
        )
    return anchors, poses


def with_poses(graph: Graph, poses: Float[np.ndarray, "N 3"]) -> Graph:
    """The graph at other poses, angles wrapped; fixed ones stay as they are, to the bit."""
    poses[:, 2] = np.pi - np.mod(np.pi - poses[:, 2], 2 * np.pi)
    fixed = np.asarray(graph.fixed_pose)
    poses[fixed] = np.asarray(graph.poses)[fixed]
    return graph._replace(poses=as_before(graph.poses, poses))


def as_before(before: JaxOrNumPy, values: np.ndarray) -> np.ndarray:
    """The values in the dtype of the previous ones, unless that is an integer dtype."""
    dtype = np.asarray(before).dtype
    return values.astype(dtype) if np.issubdtype(dtype, np.floating) else values


def with_points(
    graph: Graph, factors: Factors | None, placed: Bool[np.ndarray, "P"] | None = None
) -> Graph:
    """The graph with each point placed by a measurement from the pose of the lowest id that can.

    Points that are fixed or placed already stay, and those without such a measurement.
    """
    points = np.array(graph.points, np.float64)
    known = factors_of("graphs.starts", graph, factors)
    placed_already = np.asarray(graph.fixed_point) | (False if placed is None else placed)
    for key, table in graph.tables.items():
        factor = known[key]
        if factor.variables != ("pose", "point") or factor.predict is None:
            continue
        who, z = (np.asarray(part)[np.asarray(table.valid)] for part in (table.who, table.z))
        rows = _by_id(graph, who[:, :1], z)
        who, z = who[rows], z[rows]
        found, at = np.unique(who[:, 1], return_index=True)
        at = at[~placed_already[found]]
        if len(at):
            poses = np.asarray(graph.poses)[who[at, 0]]
            points[who[at, 1]] = _predicted_poses(factor, poses, z[at])
            placed_already[who[at, 1]] = True
    return graph._replace(points=as_before(graph.points, points))


@partial(jax.jit, inline=True)
def _predicted_poses(factor: Factor, poses: jax.Array, z: jax.Array) -> jax.Array:
    """The second variables that rows measure."""
    assert factor.predict is not None
    second: jax.Array = jax.vmap(factor.predict)(poses, z)
    return second
