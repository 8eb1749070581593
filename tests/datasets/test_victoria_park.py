"""The reader of Victoria Park: a small file by hand, errors that say where, and the real file."""

from pathlib import Path

import broken
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from recordings import COV, VICTORIA, assert_log, assert_noises, assert_spoiled, mapped, write

from jaxslam import datasets
from jaxslam.core.types import Status

FILE = "victoria_park.txt"


@pytest.fixture(scope="module")
def victoria_file():
    gtsam = broken.optional("gtsam", "the file comes with the gtsam wheel")
    return gtsam.findExampleDataFile("victoria_park.txt")


def read(folder, **options):
    return datasets.victoria_park(folder / FILE, **options)


def test_victoria_by_hand(tmp_path):
    data = read(write(tmp_path, VICTORIA))
    assert_log(
        data,
        control=[[0.5, 0.1, -0.2], [1, 0, 0], [0, 0, 3.5]],
        z=[[[2.5, -3], [0, 0]], [[0, 0], [0, 0]], [[-1, 2], [3, 4]]],
        tag=[[1, -1], [-1, -1], [0, 1]],
        valid=[[True, False], [False, False], [True, True]],
    )
    assert data.tags == (5, 7)
    assert (data.steps, data.capacity, data.measurements) == (3, 2, 3)
    assert data.landmarks is None
    assert data.dropped == {}
    np.testing.assert_array_equal(data.time, [1, 2, 3])
    np.testing.assert_array_equal(data.pose, np.zeros(3))
    np.testing.assert_array_equal(data.pose_cov, np.zeros((3, 3)))
    odometry_cov = [[0.01, 0, 0], [0, 0.04, 0.001], [0, 0.001, 0.09]]
    assert_noises(data, odometry_cov, [[0.4, 0.1], [0.1, 0.3]])
    still = data.motion.noise_cov(jnp.zeros(3), jnp.zeros(3))
    np.testing.assert_array_equal(still, odometry_cov)


def test_victoria_scan_at_the_first_pose_gets_a_row_without_motion_or_noise(tmp_path):
    first = "LANDMARK 0 5 1 2 0.4 0.1 0.3\n"
    data = read(write(tmp_path, VICTORIA, FILE, first + VICTORIA[FILE]))
    assert_log(
        data,
        control=[[0, 0, 0], [0.5, 0.1, -0.2], [1, 0, 0], [0, 0, 3.5]],
        z=[[[1, 2], [0, 0]], [[2.5, -3], [0, 0]], [[0, 0], [0, 0]], [[-1, 2], [3, 4]]],
        tag=[[0, -1], [1, -1], [-1, -1], [0, 1]],
        valid=[[True, False], [True, False], [False, False], [True, True]],
    )
    np.testing.assert_array_equal(data.time, [0, 1, 2, 3])
    noise = jax.vmap(data.motion.noise_cov, (None, 0))(jnp.zeros(3), jnp.asarray(data.log.control))
    np.testing.assert_array_equal(noise[0], np.zeros((3, 3)))
    assert np.all(np.diagonal(noise[1:], axis1=1, axis2=2) == [0.01, 0.04, 0.09])


@pytest.mark.parametrize(
    ("old", "new", "line", "reason"),
    [
        ("ODOMETRY 1 2", "ODOMETRY 0 2", 4, "starts at 0, the line before ended at 1"),
        ("ODOMETRY 1 2", "ODOMETRY 1 0", 4, "returns to pose 0"),
        ("ODOMETRY 1 2", "ODOMETRY 1 1", 4, "returns to pose 1"),
        ("ODOMETRY 1 2", "ODOMETRY 1.5 2", 4, "i is not a whole number"),
        ("ODOMETRY 1 2 1", "ODOMETRY 1 2 1 9", 4, "got 12"),
        ("ODOMETRY 1 2 1", "ODOMETRY 1 2 one", 4, "dx is not a finite number: 'one'"),
        ("ODOMETRY 1 2 1", "odometry 1 2 1", 4, "unknown keyword 'odometry'"),
        ("ODOMETRY 1 2 1", "# 1 2 1", 4, "unknown keyword '#'"),
        ("ODOMETRY 1 2 1 0 0 0.01", "ODOMETRY 1 2 1 0 0 0.02", 4, "covariance differs"),
        ("ODOMETRY 0 1 0.5 0.1 -0.2 0.01", "ODOMETRY 0 1 0.5 0.1 -0.2 -1", 1, "semi-definite"),
        ("LANDMARK 4 5 -1 2 0.4", "LANDMARK 4 5 -1 2 0.5", 5, "covariance differs"),
        ("LANDMARK 4 5 -1 2", "LANDMARK 4 5 nan 2", 5, "x is not a finite number: 'nan'"),
        ("LANDMARK 4 5 -1 2", "LANDMARK 4 5 -1 inf", 5, "y is not a finite number: 'inf'"),
        ("LANDMARK 4 5", "LANDMARK 3 5", 5, "no odometry leads to pose 3"),
        ("LANDMARK 4 5", "LANDMARK 4 2", 5, "2 is a pose"),
        ("LANDMARK 4 5", "LANDMARK 4 -5", 5, "j is not a whole number"),
        ("LANDMARK 4 5", "LANDMARK 4 7", 7, "landmark 7 is measured twice from pose 4"),
        ("3 4 0.4 0.1 0.3\n", "3 4 0.4", 7, "got 5"),
        (None, "", 1, "no ODOMETRY line"),
        (None, f"ODOMETRY 0 1 0 0 0 {COV}\n", 1, "no LANDMARK line"),
        (None, "\n\nLANDMARK 0 1 0 0 1 0 1\n", 3, "no ODOMETRY line"),
    ],
)
def test_victoria_errors_say_where(tmp_path, old, new, line, reason):
    assert_spoiled(tmp_path, VICTORIA, FILE, old, new, line, reason, read)


def test_victoria_file(victoria_file):
    """The figures known of the file, and the log against another way of reading it."""
    data = datasets.victoria_park(victoria_file)
    assert (data.steps, data.measurements, data.capacity) == (6968, 3640, 151)
    assert data.log.control.shape == (6968, 3)
    assert data.log.scan.z.shape == (6968, 2, 2)
    rows = [line.split() for line in Path(victoria_file).read_text().splitlines()]
    odometry = np.array([row[1:] for row in rows if row[0] == "ODOMETRY"], float)
    sightings = [row for row in rows if row[0] == "LANDMARK"]
    np.testing.assert_array_equal(data.log.control, odometry[:, 2:5])
    row_of = {int(j): t for t, j in enumerate(odometry[:, 1])}
    expected = {(row_of[int(r[1])], int(r[2])): (float(r[3]), float(r[4])) for r in sightings}
    t, m = np.nonzero(data.log.scan.valid)
    found = zip(t, data.log.scan.tag[t, m], data.log.scan.z[t, m], strict=True)
    assert {(i, data.tags[tag]): tuple(z) for i, tag, z in found} == expected
    cov = data.motion.noise_cov(jnp.zeros(3), jnp.ones(3))
    np.testing.assert_allclose(np.sqrt(np.diagonal(cov)), [0.01, 0.002, 0.002], rtol=1e-12)


@pytest.mark.sweep
def test_ekf_maps_victoria_park(victoria_file):
    """All of it: finite, and the joint covariance positive definite after every step."""
    data = datasets.victoria_park(victoria_file)
    found = mapped(data, probe=lambda s: jnp.isfinite(jnp.linalg.cholesky(s.cov)).all())
    assert found.probe.shape == (data.steps,)
    assert found.probe.all()
    assert np.all(np.isfinite(found.final.points))
    assert found.final.alive.all()
    assert (found.info.status == Status.BORN).sum() == 151
    assert (found.info.status == Status.FUSED).sum() == 3640 - 151
    assert found.nis_per_dof == pytest.approx(0.912, abs=0.005)
