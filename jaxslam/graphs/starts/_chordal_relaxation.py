"""The chordal start: headings from a linear relaxation, then positions."""

import numpy as np
import scipy  # its parts load where they are used
from jaxtyping import Bool, Float

from jaxslam.core.validation import refusals_of
from jaxslam.graphs._graph import Graph, Table
from jaxslam.graphs.starts._relative import (
    Factors,
    Relative,
    anchors_of,
    as_before,
    measured_relative_poses,
    with_points,
    with_poses,
)


def chordal(graph: Graph, factors: Factors | None = None) -> Graph:
    """The graph with its headings from the chordal relaxation, its positions from these headings.

    With c = (cos θ, sin θ) as a complex number, headings minimize the quadratic cost

        Σ κ_ij |c_j - c_i exp(i φ_ij)|²

    over complex numbers that need not have length one, φ and κ being measured angle and its
    information; θ is the argument of each. For these headings χ² of relative poses and relative
    positions is quadratic in the positions, and is minimized over them, its terms between angle and
    position included. Rotations first: Carlone, Tron, Daniilidis & Dellaert 2015, "Initialization
    techniques for 3D SLAM: a survey on rotation estimation and its use in pose graph optimization",
    ICRA; the relaxation is that of Martinec & Pajdla 2007, CVPR.

    Arguments, points that no relative position places, and errors are those of `odometry`.
    """
    with refusals_of("chordal"):
        relative = measured_relative_poses(graph, factors)
        anchors, poses = anchors_of(graph, relative)
    poses[:, 2] = _headings(relative, anchors, poses[:, 2])
    placed = np.zeros(len(graph.points), bool)
    if (table := graph.tables.get("relative_position")) is not None:
        placed[np.asarray(table.who)[np.asarray(table.valid), 1]] = True
    return with_points(_positions(graph, relative, anchors, poses), factors, placed)


def _headings(
    relative: Relative, anchors: Bool[np.ndarray, "N"], held: Float[np.ndarray, "N"]
) -> Float[np.ndarray, "N"]:
    """The headings of the chordal relaxation; anchors keep theirs."""
    i, j, rows = relative.first, relative.second, np.arange(len(relative.first))
    root = np.sqrt(np.maximum(relative.information[:, 2, 2], 0.0))
    turn = np.exp(1j * relative.pose[:, 2])
    system = scipy.sparse.coo_array(
        (np.concatenate([root, -root * turn]), (np.tile(rows, 2), np.concatenate([j, i]))),
        shape=(len(rows), len(anchors)),
    ).tocsc()
    c = np.exp(1j * held)
    # The c that minimize |a c - b|², with those of the anchors on the right-hand side.
    a, b = system[:, ~anchors], -(system[:, anchors] @ c[anchors])
    c[~anchors] = _solve(a.conj().T @ a, a.conj().T @ b)
    return np.where(anchors, held, np.angle(c))


def _positions(
    graph: Graph,
    relative: Relative,
    anchors: Bool[np.ndarray, "N"],
    poses: Float[np.ndarray, "N 3"],
) -> Graph:
    """The graph at the positions that minimize χ² for given headings."""
    blocks = [_relative_rows(relative, poses[:, 2])]
    points, count = np.array(graph.points, np.float64), len(poses)
    if "relative_position" in graph.tables:
        blocks.append(_point_rows(graph.tables["relative_position"], poses[:, 2], count))
    first, second, turn, target, information, shift = (
        np.concatenate(parts) for parts in zip(*blocks, strict=True)
    )
    held = np.concatenate([anchors, np.asarray(graph.fixed_point)])
    named = np.isin(np.arange(len(held)), np.concatenate([first, second]))
    free = ~held & named
    values = np.concatenate([poses[:, :2], points[:, :2].reshape(-1, 2)])
    # e = A t - b with A = turn at the second and -turn at the first: Aᵀ (Ω (A t - b) + s) = 0.
    # Row 2r + i and column 2v + j of A have the entry (i, j) of row r and variable v.
    rows = 2 * np.arange(len(first))[:, None, None] + np.arange(2)[None, :, None]
    rows = np.broadcast_to(rows, turn.shape)
    columns = [
        np.broadcast_to(2 * end[:, None, None] + np.arange(2)[None, None], turn.shape)
        for end in (second, first)
    ]
    system = scipy.sparse.coo_array(
        (
            np.concatenate([turn.ravel(), -turn.ravel()]),
            (np.tile(rows.ravel(), 2), np.concatenate([part.ravel() for part in columns])),
        ),
        shape=(2 * len(first), 2 * len(held)),
    ).tocsc()
    within = [np.broadcast_to(axis, information.shape) for axis in (rows, np.swapaxes(rows, 1, 2))]
    weight = scipy.sparse.coo_array(
        (information.ravel(), tuple(part.ravel() for part in within)), shape=(2 * len(first),) * 2
    ).tocsc()
    of_free = np.repeat(free, 2)
    a = system[:, of_free]
    away = system[:, ~of_free] @ values[~free].ravel() - target.ravel()
    solved = _solve(a.T @ weight @ a, -(a.T @ (weight @ away + shift.ravel())))
    values[free] = solved.reshape(-1, 2)
    poses[:, :2] = values[:count]
    points[:, :2] = values[count:]
    return with_poses(graph, poses)._replace(points=as_before(graph.points, points))


def _relative_rows(relative: Relative, headings: Float[np.ndarray, "N"]) -> tuple[np.ndarray, ...]:
    """First and second variable, the matrix of the positions, b, Ω and s of relative poses.

    e_t = R_zᵀ (R_iᵀ (t_j - t_i) - t_z), and s = Ω_tθ e_θ.
    """
    i, j, z, information = relative
    wrapped = np.angle(np.exp(1j * (headings[j] - headings[i] - z[:, 2])))
    target = np.einsum("eba,eb->ea", _rotations(z[:, 2]), z[:, :2])
    turn = np.swapaxes(_rotations(headings[i] + z[:, 2]), 1, 2)
    return i, j, turn, target, information[:, :2, :2], information[:, :2, 2] * wrapped[:, None]


def _point_rows(
    table: Table, headings: Float[np.ndarray, "N"], count: int
) -> tuple[np.ndarray, ...]:
    """The terms of relative positions, as of `_relative_rows`: e = R_iᵀ (l - t_i) - z, s = 0.

    Points are counted on from the poses.
    """
    valid = np.asarray(table.valid)
    who, z = np.asarray(table.who)[valid], np.asarray(table.z, float)[valid]
    turn = np.swapaxes(_rotations(headings[who[:, 0]]), 1, 2)
    information = np.asarray(table.information, float)[valid]
    return who[:, 0], count + who[:, 1], turn, z, information, np.zeros_like(z)


def _rotations(angles: Float[np.ndarray, "E"]) -> Float[np.ndarray, "E 2 2"]:
    """The rotation matrices of angles."""
    c, s = np.cos(angles), np.sin(angles)
    return np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)


def _solve(matrix: "scipy.sparse.csc_array", right: np.ndarray) -> np.ndarray:
    """The solution matrix⁻¹ right of a sparse positive definite matrix."""
    if matrix.shape[0] == 0:
        return np.zeros(0)
    try:
        factor = scipy.sparse.linalg.splu(
            matrix.tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        return np.asarray(factor.solve(right))
    except RuntimeError as error:
        raise ValueError(
            "chordal: the measurements do not determine all headings and positions"
        ) from error
