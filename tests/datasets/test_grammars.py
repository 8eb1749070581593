"""Every reader of texts on files of its grammar with odd tokens: an answer, or a line of ValueError."""

import chex
import hypothesis.strategies as st
import numpy as np
import pytest
from fuzzing import assert_one_line, fuzz, lines, odd, records, watched
from hypothesis import given
from recordings import BONN, MRCLAM, TEAM
from test_mutated import YAML, assert_map, assert_whole
from test_table import OWN, SETTINGS, TRUTH

from jaxslam import datasets
from jaxslam.datasets._laser_logs.carmen_odometry import odometry_of_file

COV = "0.01 0 0 0.04 0.001 0.09"
FLASER = "FLASER 3 1.5 x 2 {} 3.5 host 2"
ROBOTLASER = "ROBOTLASER1 0 -1.5 3.0 0.5 50 0.1 0 2 1 x 2 60 1 {} 0 0 0 0 0 1.0 x 8.5"
FIT = """[motion]
noise = [0.03, 0.02]  # v [m/s], omega [rad/s]
scale = [1.01, 0.99]
[sensor]
noise = [0.1, 0.05]
range = [1.02, 0.05]
[calibration]
parameters = ["motion v [m/s]", "scale travel"]
covariance = [
  [1e-4, 0],
  [0, 1e-4],
]
"""
MOST = """name = "robot"
[motion]
model = "unicycle"
noise = [0.02, 0.01]
wheels = [0.01, 0.02]
[sensor]
model = "range_bearing"
noise = [0.05, 0.02]
delay = 0.05
max_range = 5.6
across = 0.1
axis = 0.1
[filter]
spacing = 0.1
gate = 0.999
associate = "nearest"
"""


def usual(files):
    """Files that stay as they are."""
    return {name: st.just(text) for name, text in files.items()}


def assert_stamped(found):
    """Finite relations."""
    chex.assert_tree_all_finite((found.first, found.second, found.pose))


def assert_laser(log):
    """Finite numbers."""
    chex.assert_tree_all_finite((log.time, log.beams, log.corrected, log.raw, log.odometry))


def assert_graph(graph):
    """Finite numbers."""
    chex.assert_tree_all_finite((graph.poses, graph.points))


def read_odometry(path):
    return odometry_of_file(path / "odometry.txt", np.arange(3.0), "a log")


def assert_odometry(found):
    chex.assert_tree_all_finite((found[0].poses, found[1]))


POSES = lines("VERTEX_SE2 i x x x", "VERTEX_XY i x x", "EDGE_SE2 i i x x x 4 0 0 5 0 6", "FIX i")
GRAPHS = st.one_of(
    POSES,
    lines(
        "EDGE_SE2 i i x x x 1 0 0 1 0 1",
        "EDGE_SE2_XY i i x x 2 0.5 3",
        "EDGE_BEARING_SE2_XY i i x 2",
        "EDGE_PRIOR_SE2 i x x x 1 0 0 1 0 1",
        "EDGE2 i i x x x 1 x 1 1 x 0",
        "VERTEX2 i x x x",
        "# x",
        head="VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nVERTEX_XY 2 1 1\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n",
    ),
)
TABLES = {
    "odometry.csv": st.one_of(
        records("t [s],v [m/s],omega [rad/s]", "t", "x", "x"),
        records("t [s],x [m],y [m],theta [deg]", "t", "x", "x", "x"),
    ),
    "measurements.csv": st.one_of(
        records("t [s],tag,range [m],bearing [rad]", "t", "i", "x", "x"),
        records("t [ms],tag,x [m],y [m],note", "t", "i", "x", "x", "x"),
    ),
    "truth.csv": records("t [s],x [m],y [m],theta [rad]", "t", "x", "x", "x"),
    "landmarks.csv": records("tag,x [m],y [m]", "i", "x", "x"),
}
GRAMMARS = {
    "graphs": ({"graph.g2o": GRAPHS}, lambda path: datasets.read_graph(path / "graph.g2o"), assert_graph),
    "carmen": (
        {
            "room.log": lines(
                "ODOM x x x 0 0 0 x host x",
                FLASER.format("x x x x x x"),
                FLASER.format("0 0 0 0 0 0"),
                ROBOTLASER.format("x x x x x x"),
                ROBOTLASER.format("0 0 0 0 0 0"),
                "RAWLASER1 0 -1.5 3.0 0.5 50 0.1 0 2 x x 2 60 0 1.0 x 8.5",
                "FLASER 0 x x x x x x 3.5 host 2",
            )
        },
        lambda path: datasets.carmen(path / "room.log"),
        assert_laser,
    ),
    "odometry": ({"odometry.txt": lines("x x x x", "i x x x")}, read_odometry, assert_odometry),
    "relations": (
        {"a.relations": lines("x x x x 0 0 0 x", "i i x x 0 1e-9 0 x", "# *")},
        lambda path: datasets.relation_file(path / "a.relations"),
        assert_stamped,
    ),
    "map": (
        {
            "map.yaml": st.just(YAML),
            "map.pgm": st.sampled_from(
                [f"P2 3 2 9 {' '.join('123456')}", "P5\n3 2\n127\nabcdef", "P5 3 2 65535 abcdefabcdef"]
            ),
        },
        lambda path: datasets.read_map(path / "map.yaml"),
        lambda grid: assert_map(grid, None),
    ),
    "bonn": (
        usual(BONN)
        | {
            "world.dat": lines("i x x"),
            "sensor_data.dat": lines(
                "SENSOR 4 x x", "SENSOR i 1 x", "ODOMETRY x x x", head="ODOMETRY 0 0 0\n"
            ),
        },
        datasets.bonn,
        assert_whole,
    ),
    "victoria": (
        {
            "park.txt": lines(
                f"ODOMETRY i i x x x {COV}",
                "LANDMARK i 10 x x 0.4 0.1 0.3",
                head=f"ODOMETRY 0 1 x x x {COV}\nLANDMARK 1 10 1 1 0.4 0.1 0.3\n".replace("x", "1"),
            )
        },
        lambda path: datasets.victoria_park(path / "park.txt"),
        assert_whole,
    ),
    "mrclam": (
        usual(MRCLAM)
        | {
            "Robot2_Odometry.dat": lines("1248272272.5 x x", "1248272273.5 x x", "x x x"),
            "Robot2_Measurement.dat": lines("1248272272.75 72 x x", "1248272273 70 1 x", "x i x x"),
        },
        lambda path: datasets.mrclam(path, 2),
        assert_whole,
    ),
    "team": (
        usual(TEAM) | {"Barcodes.dat": lines("i i", head=TEAM["Barcodes.dat"])},
        lambda path: datasets.mrclam_team(path, (2, 1)),
        assert_whole,
    ),
    "table": (TABLES, datasets.table, assert_whole),
    "settings": (
        usual(OWN | TRUTH)
        | {
            "dataset.toml": st.sampled_from([SETTINGS["dataset.toml"], MOST, FIT, ""]),
            "fit.toml": st.sampled_from([FIT, ""]),
        },
        datasets.table,
        assert_whole,
    ),
}  # fmt: skip
"""By reader: the files and what they hold, the reader, and what holds for its answer."""


@pytest.mark.filterwarnings("ignore:.* is not read")
@pytest.mark.parametrize("name", GRAMMARS)
@fuzz(100)
@given(data=st.data())
def test_texts_of_the_grammar(name, data, tmp_path):
    files, read, assert_read = GRAMMARS[name]
    wrong = data.draw(st.sampled_from(sorted(files)))
    for file, grammar in files.items():
        text = data.draw(grammar)
        text = data.draw(odd(text)) if file == wrong else text
        (tmp_path / file).write_bytes(text.encode("utf-8", "surrogatepass"))
    try:
        found = watched(read, tmp_path)
    except ValueError as error:
        assert_one_line(error, tmp_path)
    else:
        assert_read(found)
