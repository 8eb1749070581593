"""True paths and the calibration of MRCLAM: small files by hand, and the real files."""

import gzip

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from recordings import EPOCH, MRCLAM, TEAM, assert_error, folder, write

from jaxslam import datasets
from jaxslam.datasets import MRCLAM_CALIBRATION, RobotCalibration
from jaxslam.datasets._landmark_logs.mrclam_robot import START_COV, cut_after, true_poses

TRUTH = """# Time x y theta
1248272272.000 1.0 2.0 3.0
1248272272.100 1.2 2.0 3.2
1248272272.200 1.4 2.0 3.4
1248272272.300 1.6 2.0 -2.68318531
1248272273.400 2.0 2.0 0.0
1248272273.500 2.0 3.0 0.0
"""
PLAIN = RobotCalibration(0.0, 1.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.01, 0.02, 0.5, 0.1, 0.02)


def with_truth(path, files=MRCLAM, robot=2, text=TRUTH):
    write(path, files)
    (path / f"Robot{robot}_Groundtruth.dat").write_text(text, encoding="utf-8")
    return path


def test_the_true_path_is_read(tmp_path):
    with_truth(tmp_path)
    with (tmp_path / "Robot2_Odometry.dat").open("a", encoding="utf-8") as file:
        file.write("1248272274.500 0 0\n1248272274.750 0 0\n")
    data = datasets.mrclam(tmp_path, 2)
    # Rows at 0.25, 0.5, 1, 1.5, …; lines 1.1 s apart tell nothing between them.
    np.testing.assert_array_equal(data.true_at, [True, False, False, True, False, False])
    np.testing.assert_allclose(data.true_path[0], [1.5, 2.0, 3.5 - 2 * np.pi], atol=1e-6)
    np.testing.assert_allclose(data.true_path[3], [2.0, 3.0, 0.0], atol=1e-6)
    assert data.one_frame
    np.testing.assert_array_equal(data.pose, data.true_path[0])
    np.testing.assert_array_equal(data.pose_cov, START_COV)
    # Of the three odometry lines (0, 0) later than the truth the first, at 2 s, stays.
    assert data.corrections == (
        "2 odometry lines (0, 0) of robot 2 after its true path were left out",
    )
    np.testing.assert_array_equal(data.time - EPOCH, [0.25, 0.5, 1, 1.5, 2, 3])
    np.testing.assert_array_equal(data.log.control[-1], [0, 0, 1])


def test_a_truth_that_begins_late_gives_no_start(tmp_path):
    late = "".join(f"{line}\n" for line in TRUTH.splitlines()[5:])
    data = datasets.mrclam(with_truth(tmp_path, text=late), 2)
    assert not data.one_frame
    np.testing.assert_array_equal(data.pose, np.zeros(3))
    assert data.true_at.sum() == 1


def test_files_may_be_packed(tmp_path):
    plain = datasets.mrclam(with_truth(tmp_path), 2)
    for file in list(tmp_path.iterdir()):
        (tmp_path / f"{file.name}.gz").write_bytes(gzip.compress(file.read_bytes()))
        file.unlink()
    packed = datasets.mrclam(tmp_path, 2)
    chex.assert_trees_all_equal(plain.log, packed.log)
    np.testing.assert_array_equal(plain.true_path, packed.true_path)


@pytest.mark.parametrize(
    ("old", "new", "line", "reason"),
    [
        ("272.100 1.2", "271.900 1.2", 3, "time goes back from"),
        ("2.0 3.2", "2.0", 3, "expected 4 fields (time x y theta), got 3"),
        ("2.0 3.2", "2.0 nan", 3, "theta is not a finite number"),
        (TRUTH, "# Time x y theta\n", 1, "expected lines time "),
    ],
)
def test_errors_in_the_truth_say_where(tmp_path, old, new, line, reason):
    with_truth(tmp_path, text=TRUTH.replace(old, new))
    path = tmp_path / "Robot2_Groundtruth.dat"
    assert_error(path, line, reason, lambda: datasets.mrclam(tmp_path, 2))


def test_a_team_has_the_true_path_of_each(tmp_path):
    with_truth(tmp_path, TEAM, robot=2)
    alone = datasets.mrclam_team(tmp_path, (2, 1))
    assert alone.true_paths is None  # robot 1 has none
    assert alone.true_path is not None
    with_truth(tmp_path, TEAM, robot=1, text=TRUTH.replace(" 2.0 ", " 7.0 "))
    both = datasets.mrclam_team(tmp_path, (2, 1))
    assert both.true_paths.shape == (2, both.steps, 3)
    np.testing.assert_array_equal(both.true_paths[0], both.true_path)
    np.testing.assert_array_equal(both.true_paths_at[1], both.true_at)
    assert both.true_paths[1, 0, 1] == 7.0


def test_true_poses_are_known_between_near_lines_and_at_lines():
    truth = np.array([[0.0, 0, 0, 0], [0.1, 1, 0, 0], [5.0, 2, 0, 0]])
    _, known = true_poses(truth, np.array([-1.0, 0.0, 0.05, 0.1, 2.0, 5.0, 6.0]))
    np.testing.assert_array_equal(known, [False, True, True, True, False, True, False])
    _, known = true_poses(truth[:1], np.array([0.0, 1.0]))
    np.testing.assert_array_equal(known, [True, False])


def test_only_zeros_at_the_end_and_after_the_truth_are_cut():
    odometry = np.array([[0, 1, 0], [1, 0, 0], [2, 1, 0], [3, 0, 0], [4, 0, 0], [5, 0, 0]], float)
    left, cut = cut_after(odometry, 3.0)
    assert cut == 1
    np.testing.assert_array_equal(left, odometry[:5])
    assert cut_after(odometry[:3], 0.5)[1] == 0


def test_a_calibration_models_what_a_robot_recorded(tmp_path):
    own = PLAIN._replace(delay=0.5, forward=2.0, outer=0.5, turn=0.5, depth=2.0, ahead=0.1, yaw=0.2)
    own = own._replace(axis=0.05)
    raw, data = (datasets.mrclam(write(tmp_path, MRCLAM), 2, calibration=c) for c in (None, own))
    # The first line (0.5 m/s, 0.125 rad/s) at 0.5 s moves the robot from 1 s on.
    row = np.searchsorted(data.time - EPOCH, 1.0) + 1
    np.testing.assert_array_equal(data.log.control[row, :2], [0.5, 0.125])
    moved = data.motion.step(jnp.zeros(3), jnp.array([0.5, 0.125, 1.0]), jnp.zeros(2))
    np.testing.assert_allclose(moved, [2 * 0.5 - 0.5 * 0.125, 0.0, 0.0625], rtol=1e-6)
    z, seen = raw.log.scan.z[raw.log.scan.valid], data.log.scan.z[data.log.scan.valid]
    np.testing.assert_allclose(seen[:, 0], z[:, 0] / np.cos(z[:, 1] - 0.05) / 2)
    np.testing.assert_array_equal(seen[:, 1], z[:, 1])
    # A camera 0.1 m ahead and turned by 0.2 rad sees a point 1.1 m ahead at 1 m and -0.2 rad.
    found = data.sensor.observe(jnp.zeros(3), jnp.array([1.1, 0.0]))
    np.testing.assert_allclose(found, [1.0, -0.2], atol=1e-6)


def test_a_later_delay_is_a_log_of_later_odometry(tmp_path):
    """Of the parameters of a data set; where velocities are constant it is that of the reader."""
    read = write(tmp_path, MRCLAM)
    data = datasets.mrclam(read, 2, calibration=PLAIN)
    later = datasets.mrclam(read, 2, calibration=PLAIN._replace(delay=0.5))
    moved, _, _ = data.adjustable.at(jnp.asarray(data.adjustable.values).at[0].set(0.5))

    def travelled(log, time):
        return time - EPOCH, np.cumsum(log.control[:, :2] * log.control[:, 2:], axis=0)

    when, expected = travelled(later.log, later.time)
    at, found = travelled(moved, data.time)
    for column in range(2):
        np.testing.assert_allclose(
            found[:, column], np.interp(at, when, expected[:, column]), atol=1e-5
        )


def test_a_bearing_behind_the_image_plane_is_refused(tmp_path):
    files = {k: v.replace("1.50 0.25", "1.50 1.6") for k, v in MRCLAM.items()}
    with pytest.raises(ValueError, match=r"expected bearings below π/2, got 1\.6"):
        datasets.mrclam(write(tmp_path, files), 2, calibration=PLAIN)


def test_ranges_of_data_set_6_are_depths():
    """Against the survey and the true path of robot 1: 0.12 m as recorded, 1 % once corrected."""
    path = folder("mrclam6")
    off = {}
    for name, calibration in (("recorded", None), ("corrected", MRCLAM_CALIBRATION)):
        data = datasets.mrclam(path, 1, calibration=calibration)
        row, slot = np.nonzero(data.log.scan.valid & data.true_at[:, None])
        pose, z = data.true_path[row], data.log.scan.z[row, slot]
        point = data.landmarks[data.log.scan.tag[row, slot]]
        expected = jax.vmap(data.sensor.observe)(pose, point)
        off[name] = z[:, 0] / np.asarray(expected[:, 0]) - 1
    assert len(off["recorded"]) > 1500
    assert off["recorded"].std() > 0.03
    assert off["corrected"].std() < 0.0105
    assert abs(off["corrected"].mean()) < 0.003
