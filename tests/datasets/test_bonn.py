"""The reader of the Bonn data: small files by hand, errors that say where, and the real files."""

import numpy as np
import pytest
from recordings import BONN, assert_log, assert_spoiled, folder, mapped, write

from jaxslam import datasets
from jaxslam.core.types import Status


def test_bonn_by_hand(tmp_path):
    data = datasets.bonn(write(tmp_path, BONN))
    assert_log(
        data,
        control=[[2 * np.cos(0.1), 2 * np.sin(0.1), -0.2], [-1, 0, 0], [0, 0, 4]],
        z=[[[1.5, 0.25], [2.5, -3]], [[0, 0], [0, 0]], [[0.5, 1], [0, 0]]],
        tag=[[1, 0], [-1, -1], [0, -1]],
        valid=[[True, True], [False, False], [True, False]],
    )
    assert data.tags == (2, 4)
    assert data.dropped == {"negative ranges": 1}
    np.testing.assert_array_equal(data.landmarks, [[0, 3], [1.5, -2]])
    np.testing.assert_array_equal(data.time, [1, 2, 3])


@pytest.mark.parametrize(
    ("old", "new", "line", "reason"),
    [
        ("ODOMETRY 0 -1 0", "ODOMETRY 0 -1", 5, "expected 3 fields (rot1 trans rot2), got 2"),
        ("ODOMETRY 0 -1 0", "ODOMETRY 0 a 0", 5, "trans is not a finite number: 'a'"),
        ("ODOMETRY 0 -1 0", "ODOMETER 0 -1 0", 5, "unknown keyword 'ODOMETER'"),
        ("SENSOR 2 0.5 1", "SENSOR 2 0.5 1 1", 7, "expected 3 fields (id range bearing), got 4"),
        ("SENSOR 2 0.5 1", "SENSOR 2 0.5 nan", 7, "bearing is not a finite number: 'nan'"),
        ("SENSOR 2 0.5 1", "SENSOR 2 -inf 1", 7, "range is not a finite number: '-inf'"),
        ("SENSOR 2 0.5 1", "SENSOR 2.5 0.5 1", 7, "id is not a whole number"),
        ("SENSOR 2 0.5 1", "SENSOR 3 0.5 1", 7, "landmark 3 is not in world.dat"),
        ("SENSOR 2 0.5 1", "SENSOR 4 0.5 1", 8, "landmark 4 is measured twice in a step"),
        ("SENSOR 4 -0.25 1\n", "SENSOR 4", 8, "got 1"),
        ("ODOMETRY 0.1 2 -0.3\n", "", 1, "SENSOR before the first ODOMETRY"),
        (None, "", 1, "no ODOMETRY line"),
        (None, "ODOMETRY 0 0 0\n", 1, "no SENSOR line"),
    ],
)
def test_bonn_errors_say_where(tmp_path, old, new, line, reason):
    spoil = (BONN, "sensor_data.dat", old, new)
    assert_spoiled(tmp_path, *spoil, line, reason, datasets.bonn)


@pytest.mark.parametrize(
    ("world", "line", "reason"),
    [
        ("2 0 3\n4 1.5\n", 2, "expected 3 fields (id x y), got 2"),
        ("2 0 3\n2 1 1\n", 2, "landmark 2 occurs twice"),
        ("2 0 y\n", 1, "y is not a finite number"),
        ("-2 0 3\n", 1, "id is not a whole number"),
        ("\n", 1, "no landmark in the file"),
    ],
)
def test_bonn_world_errors_say_where(tmp_path, world, line, reason):
    spoil = (BONN, "world.dat", None, world)
    assert_spoiled(tmp_path, *spoil, line, reason, datasets.bonn)


def test_bonn_files():
    """Counts against counts by keyword in the raw file."""
    path = folder("bonn")
    data = datasets.bonn(path)
    words = [line.split() for line in (path / "sensor_data.dat").read_text().splitlines()]
    negative = sum(w[0] == "SENSOR" and float(w[2]) < 0 for w in words)
    assert data.steps == sum(w[0] == "ODOMETRY" for w in words) == 331
    assert data.measurements + negative == sum(w[0] == "SENSOR" for w in words) == 1212
    assert data.dropped == {"negative ranges": negative} == {"negative ranges": 1}
    assert data.tags == tuple(range(1, 10))
    assert data.log.scan.z.shape == (331, 7, 2)
    np.testing.assert_array_equal(data.landmarks[2], [2, 7])


def test_ekf_maps_bonn():
    data = datasets.bonn(folder("bonn"))
    found = mapped(data)
    assert (found.info.status == Status.FUSED).sum() == data.measurements - data.capacity
    assert found.rmse < 0.02
    assert 0.9 < found.nis_per_dof < 1.0
