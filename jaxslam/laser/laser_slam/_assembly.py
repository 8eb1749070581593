"""The pose graph of keyframes: odometry and loops as tables, optimum, relative covariances."""

import numpy as np
from jaxtyping import Float, Int

from jaxslam import graphs
from jaxslam.graphs import Graph, Table
from jaxslam.graphs._graph import LOOPS
from jaxslam.laser.laser_slam import _end_covariances as end_covariances
from jaxslam.math import numpy_poses as poses

_PART = 2048
"""Pairs whose covariances are computed at once."""
ROOM = 4096
"""Poses of a graph: smaller graphs are filled up to it, so that all logs share their programs."""


def table_of(
    first: Int[np.ndarray, "E"],
    second: Int[np.ndarray, "E"],
    z: Float[np.ndarray, "E 3"],
    cov: Float[np.ndarray, "E 3 3"],
) -> Table:
    """The table of relative poses z of rows `second` in the frames of rows `first` of the graph.

    Args:
        cov: of the end of z.
    """
    information = np.linalg.inv(cov)
    return Table(
        np.stack([first, second], axis=1),
        z,
        0.5 * (information + np.swapaxes(information, 1, 2)),
        np.ones(len(z), bool),
    )


def graph_of(
    path: Float[np.ndarray, "N 3"],
    keyframe: Int[np.ndarray, "N"],
    odometry: Table,
    loops: Table | None = None,
) -> Graph:
    """The graph of keyframes, whose first pose is fixed.

    Args:
        path: poses where the optimizer begins.
        keyframe: scan of each pose.
    """
    tables = {"relative_pose": odometry}
    if loops is not None and len(loops.z):
        tables[LOOPS] = loops
    return Graph(
        poses=path,
        points=np.zeros((0, 2)),
        tables=tables,
        fixed_pose=np.arange(len(path)) == 0,
        fixed_point=np.zeros(0, bool),
        pose_id=keyframe,
        point_id=np.zeros(0, int),
    )


def relative_covs(
    solution: graphs.Solution, pairs: Int[np.ndarray, "Q 2"]
) -> Float[np.ndarray, "Q 3 3"]:
    """The covariance of the end of the second pose in the frame of the first, of each pair.

    From the joint marginals of both, by the Jacobians of x_i⁻¹ ∘ x_j.
    """
    # Each pair fills the factor, so that time and memory grow with the pairs of a part.
    parts = [
        np.asarray(graphs.marginals(solution, pairs=pairs[begin : begin + _PART], room=ROOM).pairs)
        for begin in range(0, len(pairs), _PART)
    ]
    blocks = np.concatenate(parts).astype(np.float64)
    at = np.asarray(solution.graph.poses, np.float64)
    i, j = at[pairs[:, 0]], at[pairs[:, 1]]
    # x_i + δ_i is x_i ∘ R(θ_i)ᵀ δ_i to first order, which moves the end by -Ad(z)⁻¹ of it.
    by_i = -poses.adjoint(poses.between(j, i)) @ end_covariances.turns(-i[:, 2])
    by_j = end_covariances.turns(-j[:, 2])
    jacobian = np.concatenate([by_i, by_j], axis=2)
    # Blocks (Q, 2, 2, 3, 3) of the two poses to (Q, 6, 6): pose and coordinate of the row first.
    joint = np.swapaxes(blocks, 2, 3).reshape(-1, 6, 6)
    return end_covariances.propagate(jacobian, joint)
