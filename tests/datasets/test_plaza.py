"""The reader of the Plaza data: a little file worked out by hand, bad ones refused, the real one."""

import broken
import numpy as np
import pytest
import scipy.io

import jaxslam
from jaxslam import datasets, se2
from jaxslam.datasets import plaza

GOOD = {
    "DR": [[1.0, 1.0, 0.0], [2.0, 1.0, np.pi / 2], [3.0, 1.0, 0.0]],
    "TD": [
        [3.0, 2, 9, 4.0],
        [1.5, 2, 7, 5.0],
        [3.0, 2, 7, 6.0],
        [3.0, 2, 7, 7.0],
        [9.0, 2, 7, 8.0],
    ],
    "TL": [[9.0, 10.0, 20.0], [7.0, -10.0, 5.0]],
    "GT": [[0.0, 1.0, 2.0, 3.0], [2.0, 3.0, 2.0, 3.2], [3.0, 3.0, 4.0, -3.0]],
}


def written(tmp_path, **changes):
    tables = {k: v for k, v in (GOOD | changes).items() if v is not None}
    scipy.io.savemat(tmp_path / "little.mat", tables)
    return tmp_path / "little.mat"


def test_a_little_file(tmp_path):
    data = plaza(written(tmp_path), range_bias=(1.0, 0.0))
    c, s, half = np.cos(np.pi / 8), np.sin(np.pi / 8), np.sqrt(0.5)
    # Half a row at half its turn; then the other half and a straight row, in the frame between.
    control = [
        [1 + 0.5 * c, 0.5 * s, np.pi / 4],
        [0.5 * c + half, 0.5 * s + half, np.pi / 4],
    ]
    np.testing.assert_allclose(data.log.control, control, atol=1e-12)
    np.testing.assert_array_equal(data.time, [1.5, 3.0])
    np.testing.assert_array_equal(data.log.scan.z[:, :, 0], [[4, 0], [5, 3]])
    np.testing.assert_array_equal(data.log.scan.tag, [[0, -1], [0, 1]])
    np.testing.assert_array_equal(data.log.scan.valid, [[True, False], [True, True]])
    assert data.tags == (7, 9)
    np.testing.assert_array_equal(data.landmarks, [[-10, 5], [10, 20]])
    np.testing.assert_allclose(data.true_path, [[2.5, 2, 3.15 - 2 * np.pi], [3, 4, -3]], atol=1e-12)
    assert data.dropped == {
        "ranges outside the odometry": 1,
        "repeated ranges": 1,
        "ranges shorter than their bias": 0,
    }
    assert data.corrections == ("ranges: 1.0 m and 0.0 % subtracted",)


def test_nothing_is_interpolated_over_a_gap(tmp_path):
    """Of the truth, after its end, or of the odometry, in which ranges are left out and counted."""
    t = np.arange(0.0, 40.0)
    drive = np.stack([t, 0 * t + 1, 0 * t], axis=1)
    truth = np.stack([t, t, 0 * t, 0 * t], axis=1)
    ranges = np.stack([t[:-1] + 0.5, 0 * t[1:], 0 * t[1:] + 7, 0 * t[1:] + 5], axis=1)
    kept = lambda a, b: (t < a) | (t > b)  # noqa: E731
    path = written(tmp_path, DR=drive, TD=ranges, GT=truth[kept(15, 30)][:-3])
    data = plaza(path, range_bias=(0.0, 0.0))
    known = (data.time < 14) | ((data.time > 31) & (data.time < 36))
    np.testing.assert_array_equal(data.true_at, known)
    np.testing.assert_allclose(data.true_path[known, 0], data.time[known])
    assert data.rows_without_truth == (~known).sum()
    path = written(tmp_path, DR=drive[kept(15, 30)], TD=ranges, GT=truth)
    data = plaza(path, range_bias=(0.0, 0.0))
    assert data.dropped["ranges in a gap of the odometry"] == 17
    assert not ((data.time > 14) & (data.time < 31)).any() and data.measurements == 22
    assert data.true_at is None
    with pytest.raises(ValueError, match=r"no measurement is left, of .* shorter than their bias"):
        plaza(path, range_bias=(6.0, 0.0))


def test_the_bias_is_undone_and_what_is_below_it_dropped(tmp_path):
    data = plaza(written(tmp_path), range_bias=(4.5, 0.5))
    np.testing.assert_allclose(data.log.scan.z[data.log.scan.valid][:, 0], [0.5 / 1.5, 1.0])
    assert data.dropped["ranges shorter than their bias"] == 1
    raw = plaza(written(tmp_path), range_bias=(0.0, 0.0))
    np.testing.assert_array_equal(raw.log.scan.z[raw.log.scan.valid][:, 0], [5, 6, 4])
    assert raw.corrections == ()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"DR": None}, "no table DR"),
        ({"GT": [[0.0, 1.0]]}, r"expected GT of shape \(at least 1, 4\), got \(1, 2\)"),
        ({"TL": np.zeros((0, 3))}, "expected TL of shape"),
        ({"TD": [[1.0, 2, 7, np.nan]]}, "TD has something other than finite"),
        ({"TD": [["a", "b", "c", "d"]]}, "TD"),
        ({"TD": [[1.0, 2, 8, 3.0]]}, "ranges of beacon 8"),
        ({"TD": [[1.0, 2, 7.5, 3.0]]}, "not whole"),
        ({"TD": [[1.0, 2, 7, -3.0]]}, "not above 0"),
        ({"TD": [[99.0, 2, 7, 3.0]]}, "no range in TD"),
        ({"TL": [[7, 0, 0], [7, 1, 1], [9, 0, 0]]}, "occurs twice"),
        ({"DR": [[1.0, 1, 0], [1.0, 1, 0]]}, "times of DR"),
        ({"GT": GOOD["GT"][::-1]}, "times of GT"),
    ],
)
def test_bad_files_are_refused(tmp_path, changes, message):
    path = written(tmp_path, **changes)
    with pytest.raises(ValueError, match=message) as caught:
        plaza(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_what_is_no_such_file_is_refused(tmp_path):
    (tmp_path / "text.mat").write_text("DR 1 2 3\n" * 50)
    (tmp_path / "empty.mat").write_bytes(b"")
    for name in ("text.mat", "empty.mat", "none.mat"):
        with pytest.raises(ValueError, match=f"{name}: cannot be read"):
            plaza(tmp_path / name)


@pytest.fixture(scope="module")
def plaza1():
    gtsam = broken.optional("gtsam", "the file comes with the gtsam wheel")
    return plaza(gtsam.findExampleDataFile("Plaza1_.mat"))


def test_the_odometry_leads_along_the_ground_truth(plaza1):
    """Dead reckoning from the increments, in plain NumPy, is metres off after 1.9 km."""
    assert (plaza1.steps, plaza1.measurements, plaza1.capacity) == (3526, 3527, 4)
    path, pose = [], np.zeros(3)
    for dx, dy, turn in plaza1.log.control:
        c, s = np.cos(pose[2]), np.sin(pose[2])
        pose = pose + [c * dx - s * dy, s * dx + c * dy, turn]
        path.append(pose[:2])
    true = plaza1.true_path[:, :2]
    motion = np.asarray(se2.align(np.array(path), true))
    c, s = np.cos(motion[2]), np.sin(motion[2])
    there = np.array(path) @ np.array([[c, s], [-s, c]]) + motion[:2]
    assert np.sqrt(((there - true) ** 2).sum(axis=1).mean()) < 3
    # The ranges, their bias undone, are those of the survey.
    rows, places = np.nonzero(plaza1.log.scan.valid)
    distance = np.linalg.norm(
        true[rows] - plaza1.landmarks[plaza1.log.scan.tag[rows, places]], axis=1
    )
    off = plaza1.log.scan.z[rows, places, 0] - distance
    assert abs(off.mean()) < 0.05
    assert 0.4 < off.std() < 0.6
    assert jaxslam.datasets.plaza is datasets.plaza
