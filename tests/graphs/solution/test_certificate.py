"""The certificate of global optimality, against dense matrices, at a right and a wrong optimum."""

import numpy as np
import pytest
from pose_rings import SIZE, ring

from jaxslam import graphs, sensors

WEIGHTS = np.array([40.0, 40.0, 300.0])


def isotropic(seed=0):
    """A ring without chords."""
    graph = ring(seed)
    table = graph.tables["relative_pose"]
    kept = table._replace(
        information=np.broadcast_to(np.diag(WEIGHTS), table.information.shape).copy(),
        valid=np.arange(len(table.who)) < SIZE,
    )
    return graph._replace(tables={"relative_pose": kept})


def folded(graph):
    """The graph with headings that do not turn around the ring, a start of a wrong optimum."""
    poses = np.array(graph.poses)
    poses[:, 2] = poses[0, 2]
    return graph._replace(poses=poses)


def smallest(graph):
    """(chordal cost, Σλ, smallest eigenvalue of the dual matrix without positions)."""
    table = graph.tables["relative_pose"]
    poses, real = np.asarray(graph.poses), np.asarray(table.valid)
    form = np.zeros((2 * SIZE, 2 * SIZE), complex)
    for (i, j), z in zip(np.asarray(table.who)[real], np.asarray(table.z)[real], strict=True):
        for weight, row in (
            (WEIGHTS[0], {j: 1, i: -1, SIZE + i: -(z[0] + 1j * z[1])}),
            (WEIGHTS[2], {SIZE + j: 1, SIZE + i: -np.exp(1j * z[2])}),
        ):
            a = np.zeros(2 * SIZE, complex)
            for at, value in row.items():
                a[at] = value
            form += weight * np.outer(a.conj(), a)
    x = np.concatenate([poses[:, 0] + 1j * poses[:, 1], np.exp(1j * poses[:, 2])])
    multipliers = (x.conj() * (form @ x)).real[SIZE:]
    p, u = slice(0, SIZE), slice(SIZE, None)
    reduced = form[u, u] - form[u, p] @ np.linalg.pinv(form[p, p]) @ form[p, u]
    values = np.linalg.eigvalsh(reduced - np.diag(multipliers))
    return (x.conj() @ form @ x).real, multipliers.sum(), values[0]


@pytest.mark.parametrize("wrong", [False, True])
def test_it_tells_the_global_optimum_from_another(wrong):
    graph = isotropic()
    solution = graphs.optimize(folded(graph) if wrong else graph)
    found = graphs.certificate(solution.graph)
    chi2, bound, least = smallest(found.graph)
    np.testing.assert_allclose(found.chi2, chi2, rtol=1e-9)
    assert bool(found.certified) is not wrong
    # The matrix has numbers of some thousands.
    np.testing.assert_allclose(found.smallest, least, rtol=1e-4, atol=1e-7)
    assert found.gap >= chi2 - bound - SIZE * min(least, 0) - 1e-9
    if not wrong:
        assert found.position < 0.1 and found.heading < 0.1
    else:
        best = graphs.certificate(graphs.optimize(graph).graph)
        assert found.chi2 > 2 * best.chi2
        assert found.chi2 - found.gap <= best.chi2


def test_a_prior_is_a_gauge_and_two_are_refused():
    graph = isotropic()
    prior = graphs.Table(
        np.array([[4]], np.int32), graph.poses[4:5], np.eye(3)[None], np.ones(1, bool)
    )
    free = graph._replace(fixed_pose=np.zeros(SIZE, bool), tables={**graph.tables, "prior": prior})
    found = graphs.certificate(graphs.optimize(free).graph)
    held = graphs.certificate(graphs.optimize(graph).graph)
    assert found.certified
    np.testing.assert_allclose(found.chi2, held.chi2, rtol=1e-9)
    with pytest.raises(ValueError, match="expected one pose that is fixed or has a prior, got 2"):
        graphs.certificate(free._replace(fixed_pose=graph.fixed_pose))


def test_a_factor_without_a_chordal_cost_is_refused():
    graph = isotropic()
    seen = graphs.Table(
        np.zeros((1, 2), np.int32), np.zeros((1, 1)), np.ones((1, 1, 1)), np.ones(1, bool)
    )
    with pytest.raises(ValueError, match="'bearing' has no chordal cost"):
        graphs.certificate(
            graph._replace(
                tables={**graph.tables, "bearing": seen},
                points=np.ones((1, 2)),
                fixed_point=np.ones(1, bool),
                point_id=np.zeros(1, int),
            )
        )


def test_a_sensor_of_the_same_name_on_a_mount_is_refused():
    """Its residual is another one than that of a relative position from the robot's own place."""
    graph = isotropic()
    seen = graphs.Table(
        np.zeros((1, 2), np.int32), np.zeros((1, 2)), np.eye(2)[None], np.ones(1, bool)
    )
    mounted = graphs.FromSensor(sensors.RelativePosition(np.eye(2), mount=[1.0, 0.0, 0.5]))
    with pytest.raises(ValueError, match="'seen' has no chordal cost: its factor is relative_pos"):
        graphs.certificate(
            graph._replace(
                tables={**graph.tables, "seen": seen},
                points=np.ones((1, 2)),
                fixed_point=np.ones(1, bool),
                point_id=np.zeros(1, int),
            ),
            {"relative_pose": graphs.RelativePose(), "seen": mounted},
        )
