"""Laser logs: what is read of each line, what is dropped and said, and errors with their line."""

import gzip

import numpy as np
import pytest

from benchmarks.real_data import DATA
from jaxslam import datasets

ODOM = "ODOM {x} 0.5 7.0 0.1 0.2 0 {t} host 12.5"
FLASER = "FLASER 4 1.5 nan 81.91 0 1 2 0.5 1 2 0.5 {t} host 3.25"
FIRST = "ROBOTLASER1 0 -1.5 3.0 0.5 50 0.1 0 3 1 2 60 1 9 4 5 0.5 6 7 -0.5 0 0 0 0 0 1.0 x 8.5"


def written(path, *lines, end="\n"):
    path.write_text("\n".join(lines) + end)
    return path


@pytest.fixture
def log(tmp_path):
    lines = "# x", "PARAM a b", FLASER.format(t=1), ODOM.format(x=1, t=2), ODOM.format(x=3, t=4)
    return datasets.carmen(written(tmp_path / "room.log", *lines, FLASER.format(t=5), FIRST))


def test_every_line_is_read(log):
    assert (log.name, log.max_range) == ("room", 50.0)
    np.testing.assert_allclose(log.time, [1, 5])
    np.testing.assert_allclose(log.odometry, [[1, 0.5, 7 - 2 * np.pi], [3, 0.5, 7 - 2 * np.pi]])
    np.testing.assert_allclose(log.odometry_time, [2, 4])
    np.testing.assert_array_equal(log.row, [-1, 1])
    np.testing.assert_allclose(log.raw[:, 0], [1, 3])
    np.testing.assert_array_equal(log.odometry_known, [True, True])
    np.testing.assert_allclose(log.corrected, [[1, 2, 0.5], [1, 2, 0.5]])
    np.testing.assert_allclose(log.beams.range[1], [1.5, 0, 50, 0])
    np.testing.assert_array_equal(log.beams.valid[1], [True, False, True, False])
    np.testing.assert_allclose(np.rad2deg(log.beams.angle[1]), [-90, -30, 30, 90])
    np.testing.assert_array_equal(log.mount, np.zeros(3))


def test_what_is_dropped_and_changed_is_told(log):
    assert log.dropped == {
        "comments": 1,
        "lines PARAM": 1,
        "scans ROBOTLASER1": 1,
        "beams without a range": 4,
    }
    assert log.corrections == ("scans before the first ODOM line, which take its pose: 1",)


def test_times_are_the_loggers_where_all_measurements_have_one_stamp(tmp_path):
    lines = [FLASER.format(t=0).replace("3.25", f"{t}") for t in (5, 7)]
    log = datasets.carmen(written(tmp_path / "a.log", ODOM.format(x=1, t=0), *lines))
    np.testing.assert_allclose(log.time, [5, 7])
    np.testing.assert_allclose(log.odometry_time, [12.5])
    assert log.corrections[0].startswith("all scans have the same timestamp")
    log = datasets.carmen(
        written(tmp_path / "b.log", ODOM.format(x=1, t=0), *[FLASER.format(t=0)] * 2)
    )
    assert log.corrections[0] == "all scans have the same time, by the logger as well"


@pytest.mark.parametrize(
    ("beams", "first", "step"),
    [
        *((180, -90, 1.0), (181, -90, 1.0), (360, -90, 0.5), (361, -90, 0.5), (1, -90, 180.0)),
        *((90, -90, 180 / 89), (682, -90, 180 / 681), (400, -50, 0.25), (401, -50, 0.25)),
    ],
)
def test_angles_follow_from_the_number_of_beams(tmp_path, beams, first, step):
    line = f"FLASER {beams} {'1.0 ' * beams}0 0 0 0 0 0 1 host 1"
    angle = np.rad2deg(datasets.carmen(written(tmp_path / "a.log", line)).beams.angle[0])
    np.testing.assert_allclose(angle, first + step * np.arange(beams), atol=1e-9)


def test_a_packed_log_without_odometry(tmp_path):
    (tmp_path / "lab.log.gz").write_bytes(gzip.compress(f"{FIRST}\n".encode()))
    log = datasets.carmen(tmp_path / "lab.log", max_range=1.5)
    np.testing.assert_allclose(log.raw, [[6, 7, -0.5]])
    np.testing.assert_allclose(log.corrected, log.raw)
    np.testing.assert_allclose(log.time, [1.0])
    np.testing.assert_allclose(log.beams.angle, [[-1.5, -1.0, -0.5]])
    np.testing.assert_allclose(log.beams.range, [[1, 1.5, 1.5]])
    assert log.odometry.shape == (0, 3)
    assert "no ODOM lines" in log.corrections[0]


@pytest.mark.parametrize(
    ("line", "why"),
    [
        (FLASER.format(t=1)[:30], "expected 15 fields in this line FLASER, got"),
        ("FLASER", "FLASER ends after 1 fields"),
        ("FLASER four 1 2", "number of values is not a whole number"),
        (FLASER.format(t=1).replace("81.91", "1,5"), "range 3 is not a number: '1,5'"),
        (FLASER.format(t=1).replace("81.91", "1_0"), "range 3 is not a number: '1_0'"),
        (FLASER.format(t="x"), "timestamp is not a finite number"),
        ("ODOM 1 2 3", "expected 9 fields"),
        (ODOM.format(x="nan", t=1), "x is not a finite number"),
        (FIRST[:70], "expected"),
    ],
)
def test_a_bad_line_is_named(tmp_path, line, why):
    path = written(tmp_path / "bad.log", FLASER.format(t=1), line, end="")
    with pytest.raises(ValueError, match=f"bad.log:2: .*{why}"):
        datasets.carmen(path)


def test_a_last_line_without_a_newline_is_told(tmp_path):
    log = datasets.carmen(written(tmp_path / "cut.log", ODOM.format(x=1, t=2), FIRST, end=""))
    assert log.corrections == ("the last line, 2, has no newline: its last number may be cut off",)


def test_a_file_without_scans_and_a_range_below_zero_are_refused(tmp_path):
    path = written(tmp_path / "none.log", ODOM.format(x=1, t=2))
    with pytest.raises(ValueError, match=r"none\.log:1: expected a line FLASER"):
        datasets.carmen(path)
    empty = written(tmp_path / "empty.log", "FLASER 0 0 0 0 0 0 0 1 host 1")
    with pytest.raises(ValueError, match=r"empty\.log:1: expected scans with beams, got 1 of 0"):
        datasets.carmen(empty)
    with pytest.raises(ValueError, match="max_range: expected a number above 0"):
        datasets.carmen(path, max_range=0.0)


ENDS = {
    "intel": 61.75,
    "csail": 1.43,
    "freiburg-101": 66.55,
    "edmonton": 1.25,
    "orebro": 38.58,
    "fhw": 28.11,
}
"""[m] between raw odometry and the corrected path at the end, the first poses being the same."""


@pytest.mark.parametrize(
    ("name", "scans", "beams", "lines"),
    [
        *(("intel", 910, 180, 14541), ("csail", 406, 361, 2394), ("freiburg-101", 292, 360, 4569)),
        *(("edmonton", 340, 180, 6351), ("orebro", 237, 181, 255), ("fhw", 488, 180, 13935)),
    ],
)
def test_public_logs(name, scans, beams, lines):
    path = DATA / "carmen" / f"{name}-corrected.log"
    if not path.with_suffix(".log.gz").exists():
        pytest.skip("the public logs are not here")
    log = datasets.carmen(path)
    assert log.beams.range.shape == (scans, beams)
    assert (len(log.odometry), len(log.row)) == (lines, scans)
    assert log.beams.range.max() <= log.max_range
    turned = np.abs(np.angle(np.exp(1j * np.diff(log.corrected[:, 2]))))
    assert np.median(turned) < 1.0
    (told,) = (what for what in log.corrections if "set the odometry" in what)
    assert f"before: {scans};" in told and f"{ENDS[name]} m at the end" in told
    assert log.odometry_known.sum() == (18 if name == "orebro" else scans)
