"""Starts along a tree of relative poses: the path of the odometry, or the fewest edges.

The robust start is the odometry, drawn by the loops that agree with it.
"""

import math

import numpy as np
import scipy  # its parts load where they are used

from jaxslam.core.validation import refusals_of
from jaxslam.graphs._graph import TRUSTED, Graph, ranks, with_loops_apart
from jaxslam.graphs._optimizer import optimize
from jaxslam.graphs._solver.kernels import DynamicCovarianceScaling
from jaxslam.graphs.starts._relative import (
    Factors,
    Relative,
    anchors_of,
    as_before,
    measured_relative_poses,
    with_points,
    with_poses,
)


def odometry(graph: Graph, factors: Factors | None = None) -> Graph:
    """The graph with its poses placed along consecutive edges, the path of the odometry.

    The tree that is followed prefers edges between poses of the nearest ids: it is the minimum
    spanning tree by |i - j|, i and j being places in the order of the ids. Of several edges between
    two poses the shortest is followed. Each point is placed by a measurement from the first pose
    that locates it. The order of poses and rows has no influence.

    Args:
        factors: see `optimize`; by default `graphs.REGISTRY`.
    Raises:
        ValueError: if some pose is not connected to an anchor by relative poses.
    """
    with refusals_of("odometry"):
        relative = measured_relative_poses(graph, factors)
        return with_points(_along_a_tree(graph, relative, nearest=True), factors)


def spanning_tree(graph: Graph, factors: Factors | None = None) -> Graph:
    """The graph with its poses placed along a tree of as few edges as possible from the anchor.

    Arguments, points and errors are those of `odometry`.
    """
    with refusals_of("spanning_tree"):
        relative = measured_relative_poses(graph, factors)
        return with_points(_along_a_tree(graph, relative, nearest=False), factors)


def _along_a_tree(graph: Graph, relative: Relative, nearest: bool) -> Graph:
    """The graph with poses composed along a tree from the anchors.

    nearest: whether the tree has the least sum of |i - j|; otherwise the fewest edges to each pose.
    """
    anchors, poses = anchors_of(graph, relative)
    # Nodes are counted in the order of the ids, which decides between trees of equal cost.
    rank = ranks(graph)
    count, first, second = len(poses), rank[relative.first], rank[relative.second]
    anchors, poses = anchors[by_id := np.argsort(rank)], poses[by_id]
    # A root besides the poses, with an edge to every anchor, makes one tree of all parts.
    roots = np.flatnonzero(anchors)
    ends = np.concatenate([first, np.full(len(roots), count)]), np.concatenate([second, roots])
    low, high = np.minimum(*ends), np.maximum(*ends)
    edges, at = np.unique(np.stack([low, high], axis=1), axis=0, return_index=True)
    # Never zero, which a sparse matrix takes for no edge.
    cost = np.ones(len(ends[0]))
    if nearest:
        cost[: len(first)] += np.abs(second - first)
    # SciPy 1.13's spanning tree takes indices of 32 bits alone.
    ends = tuple(edges.T.astype(np.int32))
    tree = scipy.sparse.coo_array((cost[at], ends), shape=(count + 1, count + 1)).tocsr()
    if nearest:
        tree = scipy.sparse.csgraph.minimum_spanning_tree(tree)
    order, before = scipy.sparse.csgraph.breadth_first_order(tree, count, directed=False)
    row_of = {(int(i), int(j)): int(row) for (i, j), row in zip(edges, at, strict=True)}
    # Python numbers: a loop over arrays of three takes many times as long.
    rows = relative.pose.tolist()
    placed = poses.tolist()
    for node in order.tolist():
        parent = int(before[node])
        if node == count or anchors[node] or parent == count:
            continue
        row = row_of[min(node, parent), max(node, parent)]
        forward = first[row] == parent
        step = rows[row] if forward else _inverse(rows[row])
        placed[node] = _compose(placed[parent], step)
    return with_poses(graph, np.array(placed).reshape(-1, 3)[rank])


def _compose(a: list[float], b: list[float]) -> list[float]:
    """The pose a ∘ b."""
    c, s = math.cos(a[2]), math.sin(a[2])
    return [a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], a[2] + b[2]]


def _inverse(a: list[float]) -> list[float]:
    """The pose a⁻¹."""
    c, s = math.cos(a[2]), math.sin(a[2])
    return [-c * a[0] - s * a[1], s * a[0] - c * a[1], -a[2]]


def robust(graph: Graph, factors: Factors | None = None) -> Graph:
    """The graph at the minimum next to its odometry with dynamic covariance scaling.

    Odometry and priors are trusted, all other rows have that kernel. A loop that contradicts
    the odometry hardly pulls, one that agrees with it does, and the next ones agree better: a start
    for graphs with false loops, unless the odometry is so poor that it contradicts the true ones.

    Agarwal et al. 2013, "Robust map optimization using dynamic covariance scaling", ICRA. Arguments
    and errors are those of `odometry` and of `graphs.optimize`.
    """
    apart = with_loops_apart(odometry(graph, factors))
    doubted = {key: DynamicCovarianceScaling() for key in apart.tables if key not in TRUSTED}
    optimum = optimize(apart, factors, kernel=doubted).graph
    points = as_before(graph.points, np.asarray(optimum.points))
    return with_poses(graph, np.array(optimum.poses))._replace(points=points)
