"""Every reader on files with a few bytes changed: an error that says where, or all of the data."""

import gzip
import math
import os
import re
from functools import cache
from pathlib import Path

import chex
import hypothesis.strategies as st
import numpy as np
import pytest
from fuzzing import EDITS, FLIPS, assert_one_line, edited, flipped, fuzz, watched
from hypothesis import given
from recordings import BONN, DATA, MRCLAM, TEAM, VICTORIA, write
from test_plaza import written
from test_table import OWN, SETTINGS, TRUTH

from jaxslam import datasets
from jaxslam.datasets import _g2o as g2o

TABLE = OWN | TRUTH | SETTINGS
READ = {
    "victoria": (VICTORIA, lambda path: datasets.victoria_park(path / "victoria_park.txt")),
    "bonn": (BONN, datasets.bonn),
    "mrclam": (MRCLAM, lambda path: datasets.mrclam(path, 2)),
    "team": (TEAM, lambda path: datasets.mrclam_team(path, (2, 1))),
    "table": (TABLE, datasets.table),
}


def measured(name, path):
    """The number of measurements in the files."""

    def lines(file, what=""):
        text = (path / file).read_bytes().decode("utf-8-sig").replace("\r\n", "\n")
        rows = (row.split() for row in text.split("\n"))
        return sum(bool(row) and row[0][0] != "#" and row[0].startswith(what) for row in rows)

    if name == "victoria":
        return lines("victoria_park.txt", "LANDMARK")
    if name == "bonn":
        return lines("sensor_data.dat", "SENSOR")
    return sum(lines(f"Robot{i}_Measurement.dat") for i in ((2,) if name == "mrclam" else (2, 1)))


def assert_whole(data):
    """Finite numbers, in shapes that fit together (`Dataset` checks them)."""
    chex.assert_tree_all_finite((data.log, data.time, data.pose, data.pose_cov))
    chex.assert_tree_all_finite(data.landmarks)
    if data.true_path is not None:
        true_at = True if data.true_at is None else data.true_at[:, None]
        np.testing.assert_array_equal(
            np.isfinite(data.true_path), np.broadcast_to(true_at, (data.steps, 3))
        )


def assert_graph(loaded, path):
    """Finite numbers of the type of the file's, and every line in a table or counted."""
    graph = loaded.graph
    chex.assert_tree_all_finite((graph.poses, graph.points))
    chex.assert_tree_all_finite([(t.z, t.information) for t in graph.tables.values()])
    fixed = sum(len(row) - 1 for row in rows_of(path) if row[0] == "FIX")
    assert graph.fixed_pose.sum() + graph.fixed_point.sum() <= fixed
    kept = sum(len(table.who) for table in graph.tables.values())
    placed = 0 if loaded.placed else len(graph.poses) + len(graph.points)
    holding = sum(row[0] != "FIX" for row in rows_of(path))
    assert kept + placed + sum(loaded.skipped.values()) == holding


def assert_laser_log(log, path):
    """Finite numbers, and every line a scan, odometry, or counted."""
    chex.assert_tree_all_finite(
        (log.time, log.beams, log.corrected, log.raw, log.odometry, log.mount)
    )
    assert (log.beams.range[log.beams.valid] > 0).all()
    left_out = sum(n for what, n in log.dropped.items() if what != "beams without a range")
    assert len(log.time) + len(log.odometry) + left_out == len(rows_of(path))


def assert_map(grid, path):
    """Log-odds within their bounds, half a level of grey from 0 or 1, and a resolution that is one."""
    assert (abs(grid.log_odds) <= math.log(254.5 / 0.5)).all()
    assert grid.resolution > 0
    chex.assert_tree_all_finite((grid.log_odds, grid.origin))


def rows_of(path):
    """The fields of each line that has any."""
    rows = (line.split() for line in path.read_bytes().decode().split("\n"))
    return [row for row in rows if row]


GRAPH = """# by hand
VERTEX_SE2 7 0.5 -1.25 0.1
VERTEX_SE2 3 1.5 0 3.5
VERTEX_XY 9 2 2
FIX 7
EDGE_SE2 7 3 1 0.25 -0.5 4 1 0.5 5 0.25 6
EDGE2 7 3 1 0.25 -0.5 4 0 4 9 0 0
EDGE_SE2_XY 3 9 0.5 1 2 0.5 3
EDGE_BEARING_SE2_XY 7 9 0.33 25
"""
EDGES = "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\nEDGE_SE2 1 2 1 0 0.5 1 0 0 1 0 1\n"
LASER = """PARAM a b
ODOM 1 0.5 7.0 0.1 0.2 0 12.5 host 1
FLASER 4 1.5 nan 81.91 0 1 2 0.5 1 2 0.5 3.25 host 2
ODOM 1 2 0.5 0 0 0 0 host 0
FLASER 2 1.5 2 1 2 0.75 1 2 0.75 4.25 host 2
RLASER 1 1.5 1 2 0.5 1 2 0.5 3.25 host 2
RAWLASER1 0 -1.5 3.0 0.5 50 0.1 0 3 1 2 60 0 1.0 x 8.5
ROBOTLASER1 0 -1.5 3.0 0.5 50 0.1 0 3 1 2 60 1 9 4 5 0.5 6 7 -0.5 0 0 0 0 0 1.0 x 8.5
"""
YAML = """image: map.pgm
resolution: 0.05   # metres
origin: [-1.5, 2.0, 0.25]
negate: 0
mode: scale
occupied_thresh: 0.65
free_thresh: 0.196
"""
OTHERS = {
    "g2o": ({"graph.g2o": GRAPH}, g2o.load, assert_graph),
    "edges alone": ({"graph.g2o": EDGES}, g2o.load, assert_graph),
    "carmen": ({"room.log": LASER}, datasets.carmen, assert_laser_log),
    "map": ({"map.yaml": YAML, "map.pgm": "P5\n3 2\n127\nabcdef"}, datasets.read_map, assert_map),
    "text map": (
        {"map.yaml": YAML, "map.pgm": "P2 3 2 9 1 2 3 4 5 6"},
        datasets.read_map,
        assert_map,
    ),
}


def assert_told(path, error):
    """One line, which begins with a file of the folder and, in a text, the number of a line of it."""
    message = str(error)
    assert "\n" not in message
    found = re.match(re.escape(f"{path}{os.sep}") + r"([\w.]+):(?:(\d+):)? ", message)
    assert found, message
    if not found[1].endswith((".toml", ".mat", ".pgm")):
        assert found[2], message
        ends = re.findall(rb"\r\n|\r|\n", (path / found[1]).read_bytes())
        assert 1 <= int(found[2]) <= len(ends) + 1


@pytest.mark.parametrize("name", READ)
@fuzz(100)
@given(data=st.data())
def test_text_with_other_bytes(name, data, tmp_path):
    files, read = READ[name]
    write(tmp_path, files)
    file = data.draw(st.sampled_from(sorted(files)))
    content = edited(files[file].encode(), data.draw(EDITS))
    (tmp_path / file).write_bytes(content)
    try:
        found = watched(read, tmp_path)
    except ValueError as error:
        assert_told(tmp_path, error)
    else:
        assert_whole(found)
        if name != "table":  # cells may be quoted over several lines
            assert found.measurements + sum(found.dropped.values()) == measured(name, tmp_path)


@pytest.mark.filterwarnings("ignore:.* is not read")
@pytest.mark.parametrize("name", OTHERS)
@fuzz(100)
@given(data=st.data())
def test_graphs_laser_logs_and_maps_with_other_bytes(name, data, tmp_path):
    files, read, assert_read = OTHERS[name]
    write(tmp_path, files)
    file = data.draw(st.sampled_from(sorted(files)))
    (tmp_path / file).write_bytes(edited(files[file].encode(), data.draw(EDITS)))
    first = tmp_path / min(files, key=lambda one: not one.endswith(".yaml"))
    try:
        found = watched(lambda _: read(first), tmp_path)
    except ValueError as error:
        assert_told(tmp_path, error)
    else:
        assert_read(found, first)


@fuzz(100)
@given(edits=EDITS)
def test_a_binary_file_with_other_bytes(edits, tmp_path):
    path = written(tmp_path)
    path.write_bytes(edited(path.read_bytes(), edits))
    try:
        found = watched(lambda _: datasets.plaza(path), tmp_path)
    except ValueError as error:
        assert_told(tmp_path, error)
    else:
        assert_whole(found)


REAL = {
    "g2o": ("graphs/MIT.g2o", g2o.load),
    "toro": ("graphs/FRH_P_toro.graph", g2o.load),
    "carmen": ("laser_graphs/mit-cscail.log.gz", datasets.carmen),
    "relations": ("relations/mit-csail.relations.gz", datasets.relation_file),
    "map": ("maps/turtlebot3_world.yaml", datasets.read_map),
    "image": ("maps/turtlebot3_world.pgm", datasets.read_map),
    "bonn": ("bonn/sensor_data.dat", lambda path: datasets.bonn(path.parent)),
    "mrclam": ("mrclam1/Robot1_Measurement.dat", lambda path: datasets.mrclam(path.parent, 1)),
}
"""A file of each format as it was published, and its reader."""
HEAD = 20_000
"""Bytes of the beginning of a text that are read."""


@cache
def real(name):
    """{file name: bytes} of a folder, long texts up to the end of a line."""
    path = DATA / REAL[name][0]
    files = {path.name: path}
    if name in ("map", "image", "bonn", "mrclam"):
        files = {each.name: each for each in path.parent.iterdir()}
    found = {}
    for file, whole in files.items():
        content = whole.read_bytes()
        content = gzip.decompress(content) if whole.suffix == ".gz" else content
        if whole.suffix != ".pgm":
            content = content[: content.find(b"\n", HEAD) + 1] or content
        found[file.removesuffix(".gz")] = content
    return found


@pytest.mark.filterwarnings("ignore:.* is not read")
@pytest.mark.parametrize("name", REAL)
@fuzz(10)
@given(flips=FLIPS)
def test_published_files_with_flipped_bits(name, flips, tmp_path):
    where, read = REAL[name]
    if not (DATA / where).exists():
        pytest.skip(f"no file {DATA / where}")
    named = Path(where).name.removesuffix(".gz")
    for file, content in real(name).items():
        (tmp_path / file).write_bytes(flipped(content, flips) if file == named else content)
    first = tmp_path / ("turtlebot3_world.yaml" if name == "image" else named)
    try:
        found = watched(lambda _: read(first), tmp_path)
    except ValueError as error:
        assert_one_line(error, tmp_path)
    else:
        chex.assert_tree_all_finite(found.graph.poses if name in ("g2o", "toro") else 0.0)
