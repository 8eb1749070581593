"""Files of relations: what is read, what is refused, and the public ones."""

import gzip

import numpy as np
import pytest

from benchmarks.real_data import DATA
from jaxslam import datasets, metrics

LINES = "# t1 t2 pose\n\n1.5 2.25 1 -2 0 0 0 4\n9 8 0.5 0.25 1e-7 0 0 -0.5\n"


@pytest.mark.parametrize("name", ["a.relations", "a.relations.gz"])
def test_relations_are_read_packed_or_not(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(gzip.compress(LINES.encode()) if name.endswith("gz") else LINES.encode())
    for asked in (path, tmp_path / "a.relations"):
        found = datasets.relation_file(asked)
        np.testing.assert_array_equal(found.first, [1.5, 9])
        np.testing.assert_array_equal(found.second, [2.25, 8])
        expected = [[1, -2, 4 - 2 * np.pi], [0.5, 0.25, -0.5]]
        np.testing.assert_allclose(found.pose, expected, atol=1e-15)
        assert found.source == str(path)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("1 2 0 0 0 0 0\n", r"1: expected 8 fields \(t1 t2 x y z roll pitch yaw\), got 7"),
        ("# one\n1 2 0 0 0 0 0 x\n", "2: yaw is not a finite number: 'x'"),
        ("nan 2 0 0 0 0 0 0\n", "1: t1 is not a finite number: 'nan'"),
        ("1 2 0 0 0.1 0 0 0\n", "1: expected a pose in the plane, with z 0, got 0.1"),
        ("1 2 0 0 0 0 -0.1 0\n", "1: expected a pose in the plane, with pitch 0, got -0.1"),
        ("# none\n", "1: expected lines t1 t2 x y z roll pitch yaw, got none"),
    ],
)
def test_a_line_that_is_no_relation_is_refused(tmp_path, text, why):
    path = tmp_path / "a.relations"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"a\.relations:" + why) as caught:
        datasets.relation_file(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("log", "odometry", "file", "joined", "dropped"),
    [
        ("laser_graphs/mit-cscail", "csail", "mit-csail", 1172, 0),
        ("carmen/intel-corrected", "intel", "intel", 90, 2894),
    ],
)
def test_relations_of_the_public_benchmark_join(log, odometry, file, joined, dropped):
    if not (DATA / "relations").exists():
        pytest.skip("the public logs are not here")
    told = datasets.relation_file(DATA / "relations" / f"{file}.relations")
    odometry = DATA / "relations" / f"{odometry}_raw_odometry.txt"
    time = datasets.carmen(DATA / f"{log}.log", odometry=odometry).time
    assert told.pose.shape == (joined + dropped, 3)
    found, without = metrics.relations_at_stamps(time, *told[:3], tolerance=1e-4)
    assert (len(found.first), without) == (joined, dropped)
