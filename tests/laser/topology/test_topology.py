"""Places, doors and routes of the office, where rooms and doors are known."""

import functools

import numpy as np
import pytest
from cases import refused
from reference.walls import is_free

from jaxslam import grids, topology
from jaxslam.simulation import walls
from jaxslam.simulation.scenarios import office

ROOMS = np.array(
    [[1.8, 1.5], [5.0, 1.5], [10.2, 1.5], [2.6, 6.2], [7.2, 6.6], [9.6, 6.6], [6.0, 4.1]]
)
"""A point in each of the six rooms, and in the corridor."""
DOORS = np.array([[1.8, 3.1], [5.0, 3.1], [10.2, 3.1], [2.6, 5.1], [7.2, 5.1], [9.6, 5.1]])


@functools.cache
def places():
    return topology.topological_map(walls.rasterize(office().walls, 0.1))


def drawn(*rows):
    """A grid of cells of 1 m: "#" wall, "." free, "?" unknown; the first row is on top."""
    values = {"#": 2.0, ".": -2.0, "?": 0.0}
    table = np.array([[values[c] for c in row] for row in rows[::-1]])
    return grids.Grid(table, np.zeros(3), np.array(1.0))


def test_the_office_has_six_rooms_a_corridor_and_six_doors():
    rooms = places()
    assert len(rooms.center) == 7 and len(rooms.doors) == 6
    at = np.array([door.position for door in rooms.doors])
    gap = np.linalg.norm(at[:, None] - DOORS[None], axis=2)
    assert sorted(gap.argmin(axis=1)) == [0, 1, 2, 3, 4, 5]
    assert gap.min(axis=1).max() < 0.2
    assert all(abs(door.width - 1.0) <= 0.2 for door in rooms.doors)
    own = topology.place_of(rooms, ROOMS)
    assert sorted(own) == list(range(7))
    for door, k in zip(rooms.doors, gap.argmin(axis=1), strict=True):
        assert set(door.places) == {own[k], own[6]}
    np.testing.assert_array_equal(rooms.adjacent.sum(axis=1)[own], [1] * 6 + [6])
    # Rooms have the areas that they have; doors belong to one side or the other.
    free = sum(np.prod(size) for size in ([3.6, 3], [4, 3], [4, 3], [4.6, 2.8], [3.4, 2.8]))
    free += 3.6 * 2.8 + 12 * 1.8 - 0.8 * 0.8 - 0.9 * 0.5 + 6 * 0.2
    assert abs(rooms.area.sum() - free) < 0.03 * free


def test_every_free_cell_has_a_place_and_no_other():
    rooms = places()
    np.testing.assert_array_equal(rooms.label >= 0, np.asarray(rooms.grid.log_odds) < 0)


def test_the_skeleton_is_thin_connected_and_far_from_walls():
    skeleton = places().skeleton
    squares = skeleton.cells[:-1, :-1] & skeleton.cells[1:, :-1]
    squares &= skeleton.cells[:-1, 1:] & skeleton.cells[1:, 1:]
    assert squares.sum() <= 2
    assert (skeleton.clearance[skeleton.cells] >= 0.2).all()
    # The corridor of 1.8 m: its middle line.
    centers = np.asarray(grids.centers(places().grid))
    middle = centers[skeleton.cells]
    inside = middle[(middle[:, 0] > 3.2) & (middle[:, 0] < 4.6) & (abs(middle[:, 1] - 4.1) < 0.8)]
    assert len(inside) >= 13 and np.abs(inside[:, 1] - 4.1).max() <= 0.11
    # Each door of the corridor is a branch.
    where = centers[skeleton.junctions]
    for x in DOORS[:, 0]:
        assert np.abs(where - [x, 4.1]).max(axis=1).min() < 0.4


def test_the_shortest_way_goes_through_the_doors():
    rooms, own = places(), topology.place_of(places(), ROOMS)
    way = topology.route(rooms, ROOMS[0], ROOMS[5])
    assert way.places == (own[0], own[6], own[5])
    np.testing.assert_array_equal(way.path[[0, -1]], ROOMS[[0, 5]])
    steps = np.linalg.norm(np.diff(way.path, axis=0), axis=1)
    assert way.length == pytest.approx(steps.sum())
    # At least the way by the doors; an eight-connected line is at most 8 % longer than a straight one.
    corners = np.stack([ROOMS[0], DOORS[0], DOORS[5], ROOMS[5]])
    least = np.linalg.norm(np.diff(corners, axis=0), axis=1).sum()
    assert least - 0.2 < way.length < 1.25 * least
    assert is_free(office().walls, way.path).all()
    assert topology.route(rooms, ROOMS[0], ROOMS[0] + 0.1).places == (own[0],)


def test_two_doors_between_the_same_rooms_are_two():
    """A wall with two gaps: union by distance alone would take the second for a loop."""
    room = "." * 9
    grid = drawn("#" * 11, *[f"#{room}#"] * 5, "##.#####.##", *[f"#{room}#"] * 5, "#" * 11)
    topology_of = topology.topological_map(grid, clearance=0.4, max_width=1.5, prominence=1.0)
    assert len(topology_of.center) == 2
    assert sorted(door.position[0] for door in topology_of.doors) == [2.5, 8.5]
    assert all(door.places == (0, 1) for door in topology_of.doors)


def test_unknown_cells_are_no_way_and_a_gap_too_narrow_connects_nothing():
    apart = drawn("#######", "#..?..#", "#..?..#", "#######")
    topology_of = topology.topological_map(apart, clearance=0.5)
    assert len(topology_of.center) == 2 and not topology_of.doors
    with pytest.raises(ValueError, match="route: no way leads from place 0 to place 1"):
        topology.route(topology_of, [1.5, 1.5], [5.5, 1.5])
    narrow = drawn(
        *["#" * 11] * 1, *["#....#....#"] * 2, "#.........#", *["#....#....#"] * 2, "#" * 11
    )
    assert len(topology.topological_map(narrow, clearance=0.8).center) == 2


def test_particles_are_summed_up_by_place():
    rooms, own = places(), topology.place_of(places(), ROOMS)
    poses = np.column_stack([ROOMS[[0, 0, 6]], np.zeros(3)])
    poses = np.concatenate([poses, [[-5.0, 0.0, 1.0]]])  # off the map
    weights, nowhere = topology.place_weights(rooms, poses, np.log([1.0, 2.0, 4.0, 1.0]) + 700)
    np.testing.assert_allclose(weights[own[[0, 6, 1]]], [3 / 8, 1 / 2, 0])
    assert nowhere == pytest.approx(1 / 8)


def test_places_of_a_path_cover_it_and_a_loop_connects_its_ends():
    around = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    poses = 5 * np.stack([np.cos(around), np.sin(around)], axis=1)
    pairs = np.stack([np.arange(39), np.arange(1, 40)], axis=1)
    open_path = topology.path_places(poses, pairs, radius=2.0)
    gap = np.linalg.norm(poses - poses[open_path.center[open_path.place]], axis=1)
    assert gap.max() <= 2.0
    count = len(open_path.center)
    assert open_path.adjacent.sum() in (2 * (count - 1), 2 * count)
    closed = topology.path_places(poses, [*pairs, (39, 0)], radius=2.0)
    assert closed.adjacent[closed.place[39], closed.place[0]] or closed.place[39] == closed.place[0]
    assert (closed.adjacent.sum(axis=1) == 2).all()


@refused(
    (lambda: topology.skeleton(drawn("###")), "skeleton: no free cell"),
    (lambda: topology.skeleton(drawn("..."), clearance=0), "skeleton: clearance: expected"),
    (
        lambda: topology.topological_map(drawn("..."), max_width=0),
        "topological_map: max_width: expected",
    ),
    (lambda: topology.route(places(), [-9, 0], ROOMS[0]), "route: start: .* is in no place"),
    (lambda: topology.place_weights(places(), np.zeros((2, 3)), [0.0]), "place_weights: exp"),
    (lambda: topology.place_weights(places(), np.zeros((1, 3)), [-np.inf]), "of weight above 0"),
    (lambda: topology.path_places([[0, 0]], [[0, 1]], radius=1), "path_places: pairs: expected"),
    (lambda: topology.path_places([[0, 0]], [], radius=0), "path_places: radius: expected"),
)
def test_bad_input_is_refused(call):
    call()
