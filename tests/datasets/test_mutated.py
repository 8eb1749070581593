"""Every reader on files with a few bytes changed: an error that says where, or all of the data."""

import os
import re

import chex
import hypothesis.strategies as st
import pytest
from hypothesis import HealthCheck, given, settings
from recordings import BONN, MRCLAM, TEAM, VICTORIA, write
from test_plaza import written
from test_table import OWN, SETTINGS, TRUTH

from jaxslam import datasets

WIDE = int(os.environ.get("JAXSLAM_FUZZ", "1"))
"""How many times as many examples are tried, as by `python -m benchmarks.fuzz`."""
fuzz = settings(
    max_examples=60 * WIDE,
    deadline=None,
    derandomize=WIDE == 1,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)

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


VALUES = st.one_of(
    st.sampled_from(b"0123456789.-+eE, \t\n\r#\"'[]=_/\x00\xff\xef"), st.integers(0, 255)
)
EDITS = st.lists(
    st.tuples(st.sampled_from("rids"), st.floats(0, 1, exclude_max=True), VALUES),
    min_size=1,
    max_size=3,
)


def edited(content, edits):
    """Bytes replaced, inserted and deleted, and lines repeated."""
    content = bytearray(content)
    for kind, where, value in edits:
        at = int(where * len(content))
        if kind == "i":
            content.insert(at, value)
        elif content and kind == "r":
            content[at] = value
        elif content and kind == "d":
            del content[at]
        elif content:  # a line twice
            begin = content.rfind(b"\n", 0, at) + 1
            end = (content.find(b"\n", at) + 1) or len(content)
            content[begin:begin] = content[begin:end]
    return bytes(content)


def assert_whole(data):
    """Finite numbers, in shapes that fit together (`Dataset` checks them)."""
    chex.assert_tree_all_finite((data.log, data.time, data.pose, data.pose_cov))
    chex.assert_tree_all_finite((data.landmarks, data.true_path))


def assert_told(path, error):
    """One line, which begins with a file of the folder and, in a text, the number of a line of it."""
    message = str(error)
    assert "\n" not in message
    found = re.match(re.escape(f"{path}{os.sep}") + r"([\w.]+):(?:(\d+):)? ", message)
    assert found, message
    if not found[1].endswith((".toml", ".mat")):
        assert found[2], message
        assert 1 <= int(found[2]) <= (path / found[1]).read_bytes().count(b"\n") + 1


@pytest.mark.parametrize("name", READ)
@fuzz
@given(data=st.data())
def test_text_with_other_bytes(name, data, tmp_path):
    files, read = READ[name]
    write(tmp_path, files)
    file = data.draw(st.sampled_from(sorted(files)))
    content = edited(files[file].encode(), data.draw(EDITS))
    (tmp_path / file).write_bytes(content)
    try:
        found = read(tmp_path)
    except ValueError as error:
        assert_told(tmp_path, error)
    else:
        assert_whole(found)
        if name != "table":  # cells may be quoted over several lines
            assert found.measurements + sum(found.dropped.values()) == measured(name, tmp_path)


@fuzz
@given(edits=EDITS)
def test_a_binary_file_with_other_bytes(edits, tmp_path):
    path = written(tmp_path)
    path.write_bytes(edited(path.read_bytes(), edits))
    try:
        found = datasets.plaza(path)
    except ValueError as error:
        assert_told(tmp_path, error)
    else:
        assert_whole(found)
