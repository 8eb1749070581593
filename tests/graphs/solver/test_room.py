"""Room for more variables: the same numbers, and one program for all graphs that fit."""

import numpy as np
import pytest
from pose_rings import SIZE, between, ring
from worlds import compilations

from jaxslam import graphs
from jaxslam.graphs.graph import LOOPS

ROOM = 64
KERNEL = {LOOPS: graphs.Cauchy()}
PAIRS = np.array([[3, 4], [9, 2], [7, 19], [0, 11]])


def with_loops(graph):
    """Its chords in a table of their own, as laser SLAM has them."""
    table = graph.tables["relative_pose"]
    chain = type(table)(*(part[:SIZE] for part in table))
    chords = type(table)(*(part[SIZE:] for part in table))
    return graph._replace(tables={"relative_pose": chain, LOOPS: chords})


def larger(graph, more=12):
    """With poses on from the last one."""
    table = graph.tables["relative_pose"]
    poses = np.concatenate([graph.poses, graph.poses[-1] + np.arange(1, more + 1)[:, None]])
    first = SIZE - 1 + np.arange(more)
    z = between(poses[first], poses[first + 1]) + 0.01
    chain = type(table)(
        np.concatenate([table.who, np.stack([first, first + 1], axis=1)]).astype(np.int32),
        np.concatenate([table.z, z]),
        np.concatenate([table.information, np.broadcast_to(100 * np.eye(3), (more, 3, 3))]),
        np.ones(len(table.z) + more, bool),
    )
    return graph._replace(
        poses=poses,
        tables={**graph.tables, "relative_pose": chain},
        fixed_pose=np.arange(SIZE + more) == 0,
        pose_id=np.arange(SIZE + more),
    )


@pytest.mark.parametrize("kernel", [None, KERNEL])
def test_the_numbers_are_those_without_room(kernel):
    graph = with_loops(ring(spread=3.0))
    alone, found = (graphs.optimize(graph, kernel=kernel, room=room) for room in (0, ROOM))
    np.testing.assert_allclose(found.graph.poses, alone.graph.poses, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.chi2, alone.chi2, rtol=1e-9)
    assert found.singular == alone.singular == -1
    assert found.graph.poses.shape == (SIZE, 3)
    at = alone.graph
    for name, weight in alone.weights.items():
        np.testing.assert_allclose(found.weights[name], weight, rtol=0, atol=1e-9)
    alone, found = (graphs.marginals(alone, pairs=PAIRS, room=room) for room in (0, ROOM))
    scale = np.abs(alone.poses).max()
    assert scale > 0 and found.pairs.shape == alone.pairs.shape
    np.testing.assert_allclose(found.poses, alone.poses, rtol=0, atol=1e-9 * scale)
    np.testing.assert_allclose(found.pairs, alone.pairs, rtol=0, atol=1e-9 * scale)
    alone, found = (graphs.squared_residuals(at, room=room) for room in (0, ROOM))
    for name, square in alone.items():
        assert len(found[name]) == len(graph.tables[name].z)
        np.testing.assert_allclose(found[name], square, rtol=1e-9, atol=1e-12)


def test_graphs_of_other_sizes_share_a_program():
    small, large = (with_loops(ring(seed=1)), larger(with_loops(ring(seed=2))))
    assert len(large.poses) > 1.5 * len(small.poses)

    def all_of(graph, pairs):
        found = graphs.optimize(graph, room=ROOM)
        at = found.graph
        robust = graphs.optimize(graph, kernel=KERNEL, room=ROOM).graph
        covs = graphs.marginals(found, pairs=pairs, room=ROOM)
        covs_alone = graphs.marginals(found, room=ROOM)
        np.testing.assert_allclose(covs.poses, covs_alone.poses, rtol=1e-9, atol=1e-15)
        return at, robust, covs, graphs.squared_residuals(at, room=ROOM)

    with compilations() as count:
        all_of(small, PAIRS)
        before = count()
        at, _, covs, squared = all_of(large, PAIRS[:2])
        assert count() == before
    assert at.poses.shape == (len(large.poses), 3) and covs.pairs.shape[0] == 2
    np.testing.assert_allclose(
        sum(np.asarray(each).sum() for each in squared.values()), graphs.chi2(at), rtol=1e-9
    )


def test_a_plan_with_room_is_shared_too():
    """One plan a graph, given, as it must be where the graph is traced."""
    graph = with_loops(ring())
    alone, room = graphs.plan(graph), graphs.plan(graph, room=ROOM)
    found = [graphs.optimize(graph, plan=plan) for plan in (alone, room)]
    np.testing.assert_allclose(found[1].graph.poses, found[0].graph.poses, rtol=0, atol=1e-9)


def test_a_graph_that_is_larger_than_the_room_is_solved_all_the_same():
    graph = larger(with_loops(ring(seed=3)), 80)
    assert len(graph.poses) > ROOM
    alone, found = (graphs.optimize(graph, room=room) for room in (0, ROOM))
    np.testing.assert_allclose(found.graph.poses, alone.graph.poses, rtol=0, atol=1e-8)


def test_what_is_not_determined_is_told_of_the_graph_that_was_given():
    graph = with_loops(ring())
    tables = dict(graph.tables)
    valid = np.ones(SIZE, bool)
    valid[[SIZE - 2, SIZE - 1]] = False  # the edges of the last pose
    tables["relative_pose"] = tables["relative_pose"]._replace(valid=valid)
    cut = graph._replace(tables=tables)
    with pytest.raises(ValueError, match=f"pose {SIZE - 1}"):
        graphs.marginals(graphs.optimize(cut, room=ROOM, iterations=0), room=ROOM)
