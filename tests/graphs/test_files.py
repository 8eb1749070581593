"""Graphs in files: small ones by hand, the round trip, errors that say where, and real files."""

import gzip
import re

import numpy as np
import pytest
import small_graphs
from cases import refused
from recordings import DATA

from jaxslam import datasets, graphs
from jaxslam.datasets import _g2o as g2o

SMALL = """# by hand
VERTEX_SE2 7 0.5 -1.25 0.1
VERTEX_SE2 3 1.5 0 3.5
VERTEX_XY 9 2 2
FIX 7
EDGE_SE2 7 3 1 0.25 -0.5 4 1 0.5 5 0.25 6
EDGE_SE2_XY 3 9 0.5 1 2 0.5 3

EDGE_SE2 3 7 -1 0 0.1 1 0 0 1 0 1
EDGE_BEARING_SE2_XY 7 9 0.3333333333333333 25
EDGE_PRIOR_SE2 3 1 0 0 1 0 0 2 0 3
"""


def wrote(folder, text, name="graph.g2o"):
    path = folder / name
    path.write_text(text)
    return path


def assert_same(a, b):
    """Numbers to the bit, types, and the order of rows."""
    assert list(a.tables) == list(b.tables)
    for key in a.tables:
        for x, y in zip(a.tables[key], b.tables[key], strict=True):
            np.testing.assert_array_equal(x, y, strict=True)
    for x, y in zip(a._replace(tables=0), b._replace(tables=0), strict=True):
        np.testing.assert_array_equal(x, y, strict=True)


def text_of(folder, graph):
    """The text of the file of a graph."""
    datasets.write_graph(folder / "text.g2o", graph)
    return (folder / "text.g2o").read_text()


def test_a_file_by_hand(tmp_path):
    loaded = g2o.load(wrote(tmp_path, SMALL))
    graph = loaded.graph
    assert loaded.skipped == {"comments": 1} and loaded.placed == 0
    np.testing.assert_array_equal(graph.pose_id, [7, 3])
    np.testing.assert_array_equal(graph.poses, [[0.5, -1.25, 0.1], [1.5, 0, 3.5]])
    np.testing.assert_array_equal(graph.point_id, [9])
    np.testing.assert_array_equal(graph.points, [[2, 2]])
    np.testing.assert_array_equal(graph.fixed_pose, [True, False])
    np.testing.assert_array_equal(graph.fixed_point, [False])
    relative = graph.tables["relative_pose"]
    np.testing.assert_array_equal(relative.who, [[0, 1], [1, 0]])
    np.testing.assert_array_equal(relative.z, [[1, 0.25, -0.5], [-1, 0, 0.1]])
    np.testing.assert_array_equal(
        relative.information, [[[4, 1, 0.5], [1, 5, 0.25], [0.5, 0.25, 6]], np.eye(3)]
    )
    np.testing.assert_array_equal(
        graph.tables["relative_position"].information, [[[2, 0.5], [0.5, 3]]]
    )
    np.testing.assert_array_equal(graph.tables["bearing"].who, [[0, 0]])
    np.testing.assert_array_equal(graph.tables["bearing"].information, [[[25]]])
    np.testing.assert_array_equal(graph.tables["prior"].who, [[1]])
    assert list(graph.tables) == ["relative_pose", "relative_position", "bearing", "prior"]


@pytest.mark.parametrize("tag", ["2", ""])
def test_toro_has_another_order(tmp_path, tag):
    """Both pairs of tags, VERTEX2 and EDGE2, VERTEX and EDGE."""
    edge = f"EDGE{tag} 0 1 1 0 0 11 12 200 300 13 23"
    text = f"VERTEX{tag} 0 0 0 0\nVERTEX{tag} 1 1 0 0\n{edge}\n"
    same = "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 11 12 13 200 23 300\n"
    toro, plain = (datasets.read_graph(wrote(tmp_path, t)) for t in (text, same))
    assert_same(toro, plain)
    np.testing.assert_array_equal(
        toro.tables["relative_pose"].information, [[[11, 12, 13], [12, 200, 23], [13, 23, 300]]]
    )


def test_what_is_no_part_of_the_graph_is_skipped_and_counted(tmp_path):
    """Offsets of sensors, to which no edge here refers, begin the files of RTAB-Map."""
    text = "PARAMS_SE2OFFSET 0 0 0 0\n" + SMALL + "VERTEX_TAG 7 here\nROBOTLASER1 0 1 2\n"
    loaded = g2o.load(wrote(tmp_path, text))
    assert loaded.skipped == {"comments": 1, "sensor offsets": 1, "notes": 1, "laser scans": 1}
    assert_same(loaded.graph, datasets.read_graph(wrote(tmp_path, SMALL)))
    with pytest.raises(ValueError, match=":15: unknown kind 'EDGE_SE2_OFFSET'"):
        g2o.load(wrote(tmp_path, text + "EDGE_SE2_OFFSET 7 3 0 0 1 0 0 1 0 0 1 0 1\n"))


def test_fixed_variables_are_written_last_and_only_where_they_are(tmp_path):
    """GTSAM's reader stops at a line FIX."""
    graph = datasets.read_graph(wrote(tmp_path, SMALL))
    assert text_of(tmp_path, graph).splitlines()[-1] == "FIX 7"
    assert "FIX" not in text_of(tmp_path, graph._replace(fixed_pose=np.zeros(2, bool)))


def test_the_round_trip_is_exact(tmp_path):
    random = np.random.default_rng(0)
    graph = datasets.read_graph(wrote(tmp_path, SMALL))
    relative = graph.tables["relative_pose"]
    root = random.normal(size=(2, 3, 3))
    graph = graph._replace(
        poses=random.normal(size=(2, 3)) * [[1e5, 1e-7, 1]],
        tables=graph.tables
        | {
            "relative_pose": relative._replace(
                z=random.normal(size=(2, 3)), information=root @ np.swapaxes(root, 1, 2)
            )
        },
    )
    path = tmp_path / "new" / "again.g2o"
    datasets.write_graph(path, graph)
    assert_same(datasets.read_graph(path), graph)
    assert [file.name for file in path.parent.iterdir()] == ["again.g2o"]
    packed = tmp_path / "packed.g2o.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    assert_same(datasets.read_graph(packed), graph)


@pytest.mark.parametrize("ending", ["toro", "graph"])
def test_toro_is_written_and_read_to_the_bit(tmp_path, ending):
    """The graph of a TORO file and that of a g2o file are the same; so are what is written."""
    random = np.random.default_rng(1)
    root = random.normal(size=(2, 3, 3))
    one = datasets.read_graph(
        wrote(tmp_path, "\n".join(SMALL.split("\n")[1:3] + SMALL.split("\n")[5:6]))
    )
    information = root @ np.swapaxes(root, 1, 2)
    table = graphs.Table(
        np.array([[0, 1], [1, 0]], np.int32),
        random.normal(size=(2, 3)),
        (information + np.swapaxes(information, 1, 2)) / 2,
        np.ones(2, bool),
    )
    poses = random.normal(size=(2, 3)) * [[1e5, 1e-7, 1]]
    graph = one._replace(poses=poses, tables={"relative_pose": table})
    path, other = tmp_path / f"a.{ending}", tmp_path / "a.g2o"
    datasets.write_graph(path, graph)
    datasets.write_graph(other, graph)
    assert [line.split()[0] for line in path.read_text().splitlines()] == [
        *("VERTEX2", "VERTEX2", "EDGE2", "EDGE2")
    ]
    assert_same(datasets.read_graph(path), graph)
    assert_same(datasets.read_graph(other), graph)
    text = path.read_text()
    datasets.write_graph(path, datasets.read_graph(path))
    assert path.read_text() == text


def test_what_toro_cannot_hold_is_refused(tmp_path):
    graph = datasets.read_graph(wrote(tmp_path, SMALL))
    posed = graph._replace(points=graph.points[:0], point_id=graph.point_id[:0])
    free = posed._replace(fixed_pose=np.zeros(2, bool))
    for lacking, message in (
        (graph, "write_graph: graph: TORO has no line for points, and it has 1"),
        (posed, "TORO has no line for fixed poses, and pose 7 is fixed"),
        (free, "TORO has no line for table 'relative_position'; it has some for relative_pose"),
        (small_graphs.only(free, "prior"), "TORO has no line for table 'prior'"),
        (small_graphs.only(free, "bearing"), "TORO has no line for table 'bearing'"),
    ):
        with pytest.raises(ValueError, match=message):
            datasets.write_graph(tmp_path / "out.toro", lacking)
    assert not (tmp_path / "out.toro").exists()


@pytest.mark.parametrize(
    ("name", "kind"), [("a.g2o.gz", b"VERTEX_SE2 "), ("a.toro.gz", b"VERTEX2 ")]
)
def test_a_packed_file_is_written_and_read_to_the_bit(tmp_path, name, kind):
    graph = small_graphs.only(datasets.read_graph(wrote(tmp_path, SMALL)), "relative_pose")
    graph = graph._replace(
        points=graph.points[:0],
        point_id=graph.point_id[:0],
        fixed_point=graph.fixed_point[:0],
        fixed_pose=np.zeros(2, bool),
    )
    datasets.write_graph(tmp_path / name, graph)
    assert gzip.decompress((tmp_path / name).read_bytes()).startswith(kind)
    assert_same(datasets.read_graph(tmp_path / name), graph)


def test_what_would_not_be_read_is_not_written(tmp_path):
    graph = datasets.read_graph(wrote(tmp_path, SMALL))
    table = graph.tables["prior"]
    skew = table.information + np.triu(np.ones((3, 3)), 1)
    for change, message in (
        ({"poses": graph.poses * np.nan}, "pose 7 is not finite"),
        ({"pose_id": np.array([7, 7])}, "pose 7 occurs twice"),
        ({"pose_id": np.array([7, -3])}, "expected ids >= 0, got -3"),
        ({"tables": {"prior": table._replace(information=skew)}}, "is not symmetric"),
        ({"tables": {"prior": table._replace(information=-table.information)}}, "semidefinite"),
    ):
        with pytest.raises(ValueError, match=f"write_graph: .*{message}"):
            datasets.write_graph(tmp_path / "out.g2o", graph._replace(**change))
    assert not (tmp_path / "out.g2o").exists()


def test_rows_that_are_not_valid_are_not_written(tmp_path):
    graph = datasets.read_graph(wrote(tmp_path, SMALL))
    table = graph.tables["relative_pose"]._replace(valid=np.array([False, True]))
    text = text_of(tmp_path, graph._replace(tables={"relative_pose/loops": table}))
    assert text.count("EDGE") == 1 and "EDGE_SE2 3 7 -1.0 0.0 0.1 1.0" in text


def test_a_file_without_vertices_is_placed_along_its_edges(tmp_path):
    """A square of unit steps, its edges in another order, one of them backwards."""
    quarter = np.pi / 2
    edges = [(12, 13, 1), (10, 11, 1), (12, 11, -1), (13, 10, 1)]
    lines = []
    for i, j, way in edges:
        z = f"1 0 {quarter}" if way == 1 else f"0 1 {-quarter}"  # the inverse of the same step
        lines.append(f"EDGE_SE2 {i} {j} {z} 1 0 0 1 0 1")
    text = "\n".join([*lines, "EDGE_SE2_XY 11 4 1 2 1 0 1", "FIX 10"])
    loaded = g2o.load(wrote(tmp_path, text))
    graph = loaded.graph
    assert loaded.placed == 5
    np.testing.assert_array_equal(graph.pose_id, [10, 11, 12, 13])
    expected = [[0, 0, 0], [1, 0, quarter], [1, 1, 2 * quarter], [0, 1, -quarter]]
    np.testing.assert_allclose(graph.poses, expected, atol=1e-15)
    np.testing.assert_allclose(graph.points, [[-1, 1]], atol=1e-15)


UNIT = "1 0 0 1 0 1"
RING = {i: f"VERTEX_SE2 {i} {i} 0 0.5" for i in (4, 1, 2, 3, 5, 9)}


def equal_vertices(form, equal, edges):
    """A file of the ring's vertices, or of edges alone, with lines EQUIV at a place."""
    vertices = [] if form == "edges alone" else [*RING.values(), "FIX 5", "VERTEX_XY 8 1 1"]
    lines = [*edges, "EDGE_SE2_XY 5 8 1 2 1 0 1", f"EDGE_PRIOR_SE2 3 0 0 0 {UNIT}"]
    parts = [equal, vertices, lines] if form == "first" else [vertices, lines, equal]
    return "\n".join(line for part in parts for line in part)


@pytest.mark.parametrize("form", ["first", "last", "edges alone"])
def test_equivalent_vertices_are_one(tmp_path, form):
    """A chain 5 = 3 = 2 and a line twice: as a file that has 2, with the pose of the fixed 5."""
    moves = {(1, 2): 1.0, (2, 3): 2.0, (3, 4): 3.0, (5, 9): 4.0, (4, 5): 5.0}
    edges = [f"EDGE_SE2 {i} {j} {x} 0 0.5 {UNIT}" for (i, j), x in moves.items()]
    equal = ["EQUIV 5 3", "EQUIV 3 2", "EQUIV 2 3", "EQUIV 4 4"]
    loaded = g2o.load(wrote(tmp_path, equal_vertices(form, equal, edges)))
    name = {3: 2, 5: 2}
    same = [
        f"EDGE_SE2 {name.get(i, i)} {name.get(j, j)} {x} 0 0.5 {UNIT}"
        for (i, j), x in moves.items()
        if (i, j) != (2, 3)
    ]
    text = equal_vertices(form, [], same).replace("XY 5", "XY 2").replace("SE2 3 0 0 0", "SE2 2 0 0 0")  # fmt: skip
    text = text.replace("FIX 5", "FIX 2").replace(RING[2], "VERTEX_SE2 2 5 0 0.5")
    text = "\n".join(line for line in text.split("\n") if line not in (RING[3], RING[5]))
    assert_same(loaded.graph, datasets.read_graph(wrote(tmp_path, text)))
    assert loaded.skipped == {
        "equivalences": 4,
        "vertices merged into another": 2,
        "edges within merged vertices": 1,
    }
    datasets.write_graph(tmp_path / "again.g2o", loaded.graph)
    again = g2o.load(tmp_path / "again.g2o")
    assert_same(again.graph, loaded.graph)
    assert not again.skipped


@refused(
    ("EQUIV 1", ":14: expected 2 fields (i j), got 1"),
    ("EQUIV 1 x", ":14: id is not a whole number >= 0: 'x'"),
    ("EQUIV 1 7", ":14: vertex 7 is not defined in the file"),
    ("EQUIV 1 8", ":14: one of the vertices 1 and 8 is a pose, the other a point"),
    ("EQUIV 1 5\nFIX 1", ":15: vertices 5 and 1 are equal, and fixed at two places"),
    escaped=True,
)
def test_what_cannot_be_equivalent_is_refused(line, tmp_path):
    edges = [f"EDGE_SE2 {i} {i + 1} 1 0 0 {UNIT}" for i in (1, 2, 3)]
    datasets.read_graph(wrote(tmp_path, equal_vertices("last", [line], edges)))


def test_angles_in_degrees_are_noted(tmp_path):
    """A circle in steps of 15°; an edge of a radian is no sign, nor is an unwrapped heading."""
    turn = np.linspace(0, 6 * np.pi, 73)

    def notes(of_pose, of_edge):
        poses = [f"VERTEX_SE2 {k} {np.sin(a)} {1 - np.cos(a)} {of_pose * a}" for k, a in enumerate(turn)]  # fmt: skip
        edges = [f"EDGE_SE2 {k} {k + 1} 0.26 0 {of_edge * turn[1]} {UNIT}" for k in range(72)]
        return g2o.load(wrote(tmp_path, "\n".join([*poses, *edges]))).notes

    degrees = 180 / np.pi
    assert notes(1, 1) == ()
    assert [note[:14] for note in notes(degrees, 1)] == ["headings of th"]
    assert notes(1, degrees)[0].startswith(
        "72 of 72 angles of relative_pose are beyond 2π, up to 15:"
    )
    assert len(notes(degrees, degrees)) == 2


def test_a_file_whose_edges_are_all_within_equal_vertices_is_refused(tmp_path):
    path = wrote(tmp_path, f"EDGE_SE2 1 2 1 0 0 {UNIT}\nEQUIV 1 2\n")
    with pytest.raises(ValueError, match=r":2: no edge is left: all are within vertices that EQU"):
        datasets.read_graph(path)


@pytest.mark.parametrize(
    ("old", "new", "line", "reason"),
    [
        ("FIX 7", "FIX", 5, "expected at least 1 field (id), got 0"),
        ("FIX 7", "FIX 8", 5, "vertex 8 is not defined in the file"),
        ("VERTEX_XY 9", "VERTEX_XY 7", 4, "vertex 7 occurs twice"),
        ("VERTEX_XY 9 2 2", "VERTEX_XY 9 2", 4, "expected 3 fields (id x y), got 2"),
        ("VERTEX_XY 9", "VERTEX_YX 9", 4, "unknown kind 'VERTEX_YX'; known: VERTEX_SE2, "),
        ("VERTEX_XY 9", "VERTEX_XY 3000000000", 4, "id is above 2147483647"),
        ("0.1\n", "nan\n", 2, "theta is not a finite number: 'nan'"),
        ("EDGE_SE2 7 3", "EDGE_SE2 7 8", 6, "vertex 8 is not defined in the file"),
        ("EDGE_SE2 7 3", "EDGE_SE2 7 9", 6, "vertex 9 is not a pose"),
        ("EDGE_SE2 7 3", "EDGE_SE2 7 7", 6, "an edge from vertex 7 to itself"),
        ("EDGE_SE2 7 3", "EDGE_SE2 -1 3", 6, "i is not a whole number >= 0: '-1'"),
        ("4 1 0.5 5 0.25 6", "4 1 0.5 5 0.25", 6, "expected 11 fields (i j x y theta I11 I12 I13"),
        ("4 1 0.5 5 0.25 6", "4 1 0.5 5 x 6", 6, "I23 is not a finite number: 'x'"),
        ("4 1 0.5 5 0.25 6", "4 5 0.5 5 0.25 6", 6, "the information is not positive semidefinite"),
        ("2 0.5 3", "2 3 3", 7, "the information is not positive semidefinite"),
        ("0.333", "1e999", 10, "bearing is not a finite number"),
    ],
)
def test_errors_say_where(tmp_path, old, new, line, reason):
    assert old in SMALL
    path = wrote(tmp_path, SMALL.replace(old, new, 1))
    with pytest.raises(ValueError, match=re.escape(f"{path}:{line}: {reason}")):
        datasets.read_graph(path)


@refused(
    ("", ":1: no edge in the file"),
    ("VERTEX_SE2 0 0 0 0\n", ":1: no edge in the file"),
    ("EDGE_SE2_XY 1 2 0 0 1 0 1\nEDGE_SE2 1 2 1 0 0 1 0 0 1 0 1\n", ":2: vertex 2 is a p"),
    ("EDGE2 0 1 1 0 0 5 0 0 5 0 5\n", ":1: the information is not positive semidefinite; EDGE2"),
    ("EDGE_SE2 0 1 1 0 0 5 0 5 5 0 0\n", ":1: the information is not positive semidefinite; EDGE2"),
    escaped=True,
)
def test_files_that_are_no_graph(text, tmp_path):
    datasets.read_graph(wrote(tmp_path, text))


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(ValueError, match="cannot be read"):
        datasets.read_graph(tmp_path / "none.g2o")


def test_what_g2o_cannot_hold_is_refused(tmp_path):
    graph = datasets.read_graph(wrote(tmp_path, SMALL))
    for change, message in (
        ({"point_id": np.array([3])}, "3 is the id of a pose and of a point"),
        ({"points": np.zeros((1, 4))}, "expected points"),
        ({"tables": {"odometry": graph.tables["prior"]}}, "no line for table 'odometry'"),
    ):
        with pytest.raises(ValueError, match=message):
            datasets.write_graph(tmp_path / "out.g2o", graph._replace(**change))
    assert not (tmp_path / "out.g2o").exists()


@pytest.mark.parametrize(
    ("name", "poses", "edges", "skipped"),
    [
        ("graphs/ring.g2o", 434, 459, {}),
        ("graphs/CSAIL.g2o", 1045, 1172, {}),
        ("laser_graphs/mit-cscail.log.gz", 1051, 1189, {"laser scans": 1051, "comments": 2}),
    ],
)
def test_real_files(tmp_path, name, poses, edges, skipped):
    if not (DATA / name).exists():
        pytest.skip(f"{DATA / name} is not there")
    loaded = g2o.load(DATA / name)
    graph = loaded.graph
    assert len(graph.poses) == poses and len(graph.tables["relative_pose"].z) == edges
    assert loaded.skipped == skipped
    datasets.write_graph(tmp_path / "again.g2o", graph)
    assert_same(datasets.read_graph(tmp_path / "again.g2o"), graph)
