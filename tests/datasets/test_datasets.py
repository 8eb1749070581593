"""Readers: little files give the log worked out by hand, bad ones an error that says where."""

import dataclasses
import os
from collections import Counter
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxslam
from jaxslam import datasets, se2
from jaxslam.datasets.lines import TextFile
from jaxslam.datasets.mrclam import EXCHANGED, white_noise
from jaxslam.filters import ekf_slam
from jaxslam.math import linalg
from jaxslam.types import Status

DATA = Path(os.environ.get("JAXSLAM_DATA", Path(__file__).parents[3] / "shared" / "data"))


def folder(name):
    if not (DATA / name).is_dir():
        pytest.skip(f"no folder {DATA / name}; set JAXSLAM_DATA to where the data sets are")
    return DATA / name


@cache
def mrclam(robot):
    return datasets.mrclam(folder("mrclam1"), robot)


@cache
def mrclam_team():
    return datasets.mrclam_team(folder("mrclam1"))


@pytest.fixture(scope="module")
def victoria_file():
    gtsam = pytest.importorskip("gtsam", reason="the file comes with the gtsam wheel")
    return gtsam.findExampleDataFile("victoria_park.txt")


def write(path, text):
    path.write_text(text, encoding="utf-8")
    return path


def assert_log(data, control, z, tag, valid):
    """The log, exactly, and in the kinds of number that were promised."""
    log = data.log
    np.testing.assert_allclose(log.control, control, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(log.scan.z, z)
    np.testing.assert_array_equal(log.scan.tag, tag)
    np.testing.assert_array_equal(log.scan.valid, valid)
    kinds = [log.control.dtype, log.scan.z.dtype, log.scan.tag.dtype, log.scan.valid.dtype]
    assert kinds == [np.float64, np.float64, np.int32, np.bool_]
    assert all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(log))


def assert_error(path, line, reason, read):
    with pytest.raises(ValueError) as caught:  # noqa: PT011 the message is compared in full below
        read()
    assert str(caught.value).startswith(f"{path}:{line}: ")
    assert reason in str(caught.value)


def run(data, probe=None):
    ekf = ekf_slam(data.motion, data.sensor, data.capacity, **data.filter_options)

    @jax.jit
    def go(log):
        trace = jaxslam.run(ekf, log, data.pose, data.pose_cov, jax.random.key(0), probe=probe)
        return trace.info, trace.estimate.pose, ekf.estimate(trace.final), trace.probe

    return jax.device_get(go(data.log))


@jax.jit
def aligned(points, survey):
    return jax.vmap(se2.from_frame, (None, 0))(se2.align(points, survey), points)


def map_rmse(final, landmarks):
    survey = np.asarray(landmarks)[final.tag]
    moved = aligned(final.points, survey)
    return float(np.sqrt(((moved - survey) ** 2).sum(axis=1).mean()))


def nis_per_dof(info):
    return np.where(info.status == Status.FUSED, info.nis, 0.0).sum() / info.dof.sum()


# --- lines ------------------------------------------------------------------------------------


def test_lines_are_numbered_from_one_and_blanks_and_comments_passed_over(tmp_path):
    file = TextFile(write(tmp_path / "f", "# a\n\n 1\t2 \r\n#b\n \t\n3"), "#")
    assert list(file) == [(3, ["1", "2"]), (6, ["3"])]


def test_without_a_comment_sign_every_line_counts(tmp_path):
    assert list(TextFile(write(tmp_path / "f", "# 1\n"))) == [(1, ["#", "1"])]


@pytest.mark.parametrize("bad", ["x", "nan", "inf", "-inf", "1_0", "1e999", "0x1", "1,5", "--1"])
def test_what_is_not_a_finite_number_is_named(tmp_path, bad):
    file = TextFile(write(tmp_path / "f", f"\n1 {bad}\n"))
    [(line, fields)] = file
    reason = f"b is not a finite number: '{bad}'"
    assert_error(tmp_path / "f", 2, reason, lambda: file.numbers(line, fields, ("a", "b")))


@pytest.mark.parametrize("bad", ["-1", "1.0", "1e3", "+1", "x", "²"])
def test_what_is_not_an_identity_is_named(tmp_path, bad):
    file = TextFile(write(tmp_path / "f", bad))
    reason = "id is not a whole number >= 0"
    assert_error(tmp_path / "f", 1, reason, lambda: file.identity(1, bad, "id"))


@pytest.mark.parametrize("text", ["1 2 3", "1"])
def test_a_wrong_number_of_fields_is_counted(tmp_path, text):
    file = TextFile(write(tmp_path / "f", text))
    [(line, fields)] = file
    reason = f"expected 2 fields (a b), got {len(fields)}"
    assert_error(tmp_path / "f", 1, reason, lambda: file.numbers(line, fields, ("a", "b")))


def test_a_file_that_is_not_text_is_refused(tmp_path):
    (tmp_path / "f").write_bytes(b"1 2\n3 \xff\n")
    assert_error(tmp_path / "f", 2, "this is not text", lambda: TextFile(tmp_path / "f"))


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    with pytest.raises(ValueError, match=f"{tmp_path}/f: cannot be read: No such file"):
        TextFile(tmp_path / "f")
    with pytest.raises(ValueError, match="cannot be read"):
        TextFile(tmp_path)


# --- the record -------------------------------------------------------------------------------


def test_a_data_set_that_does_not_fit_together_is_refused(tmp_path):
    data = datasets.victoria_park(write(tmp_path / "v.txt", VICTORIA))
    with pytest.raises(ValueError, match="expected 3 times"):
        dataclasses.replace(data, time=np.zeros(2))
    with pytest.raises(ValueError, match="not below the capacity 1"):
        dataclasses.replace(data, tags=(5,))
    with pytest.raises(ValueError, match=r"landmarks of shape \(2, 2\)"):
        dataclasses.replace(data, landmarks=np.zeros((3, 2)))
    twice = data.log.scan._replace(tag=np.zeros((3, 2), np.int32), valid=np.ones((3, 2), bool))
    with pytest.raises(ValueError, match="repeats"):
        dataclasses.replace(data, log=data.log._replace(scan=twice))


# --- Victoria Park ----------------------------------------------------------------------------

COV = "0.01 0 0 0.04 0.001 0.09"
VICTORIA = f"""ODOMETRY 0 1 0.5 0.1 -0.2 {COV}
LANDMARK 1 7 2.5 -3 0.4 0.1 0.3

ODOMETRY 1 2 1 0 0 {COV}
LANDMARK 4 5 -1 2 0.4 0.1 0.3
ODOMETRY 2 4 0 0 3.5 {COV}
LANDMARK 4 7 3 4 0.4 0.1 0.3
"""


def test_victoria_by_hand(tmp_path):
    data = datasets.victoria_park(write(tmp_path / "v.txt", VICTORIA))
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
    odometry = data.motion.noise_cov(jnp.zeros(3), jnp.zeros(3))
    np.testing.assert_array_equal(odometry, [[0.01, 0, 0], [0, 0.04, 0.001], [0, 0.001, 0.09]])
    np.testing.assert_array_equal(data.sensor.noise_cov(jnp.zeros(2)), [[0.4, 0.1], [0.1, 0.3]])


def test_victoria_scan_at_the_first_pose_gets_a_row_without_motion_or_noise(tmp_path):
    first = "LANDMARK 0 5 1 2 0.4 0.1 0.3\n"
    data = datasets.victoria_park(write(tmp_path / "v.txt", first + VICTORIA))
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


def test_victoria_noise_can_be_overridden(tmp_path):
    path = write(tmp_path / "v.txt", VICTORIA)
    data = datasets.victoria_park(path, odometry_cov=np.eye(3), measurement_cov=2 * np.eye(2))
    np.testing.assert_array_equal(data.motion.noise_cov(jnp.zeros(3), jnp.ones(3)), np.eye(3))
    np.testing.assert_array_equal(data.sensor.noise_cov(jnp.zeros(2)), 2 * np.eye(2))


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
        ("LANDMARK 4 5", "LANDMARK 4 7", 7, "landmark 7 is seen twice from pose 4"),
        ("3 4 0.4 0.1 0.3\n", "3 4 0.4", 7, "got 5"),
        (VICTORIA, "", 1, "no ODOMETRY line"),
        (VICTORIA, f"ODOMETRY 0 1 0 0 0 {COV}\n", 1, "no LANDMARK line"),
        (VICTORIA, "\n\nLANDMARK 0 1 0 0 1 0 1\n", 3, "no ODOMETRY line"),
    ],
)
def test_victoria_errors_say_where(tmp_path, old, new, line, reason):
    assert VICTORIA.count(old) == 1
    path = write(tmp_path / "v.txt", VICTORIA.replace(old, new))
    assert_error(path, line, reason, lambda: datasets.victoria_park(path))


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


# --- Bonn -------------------------------------------------------------------------------------

WORLD = "4 1.5 -2\n2 0 3\n"
SENSOR = """ODOMETRY 0.1 2 -0.3
SENSOR 4 1.5 0.25
SENSOR 2 2.5 -3

ODOMETRY 0 -1 0
ODOMETRY 0 0 4
SENSOR 2 0.5 1
SENSOR 4 -0.25 1
"""


def bonn_folder(path, world=WORLD, sensor=SENSOR):
    write(path / "world.dat", world)
    write(path / "sensor_data.dat", sensor)
    return path


def test_bonn_by_hand(tmp_path):
    data = datasets.bonn(bonn_folder(tmp_path))
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


def test_bonn_noise_can_be_overridden(tmp_path):
    kwargs = {"odometry_cov": 3 * np.eye(3), "measurement_cov": 2 * np.eye(2)}
    data = datasets.bonn(bonn_folder(tmp_path), **kwargs)
    np.testing.assert_array_equal(data.motion.noise_cov(jnp.zeros(3), jnp.ones(3)), 3 * np.eye(3))
    np.testing.assert_array_equal(data.sensor.noise_cov(jnp.zeros(2)), 2 * np.eye(2))


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
        ("SENSOR 2 0.5 1", "SENSOR 4 0.5 1", 8, "landmark 4 is seen twice in a step"),
        ("SENSOR 4 -0.25 1\n", "SENSOR 4", 8, "got 1"),
        ("ODOMETRY 0.1 2 -0.3\n", "", 1, "SENSOR before the first ODOMETRY"),
        (SENSOR, "", 1, "no ODOMETRY line"),
        (SENSOR, "ODOMETRY 0 0 0\n", 1, "no SENSOR line"),
    ],
)
def test_bonn_errors_say_where(tmp_path, old, new, line, reason):
    assert SENSOR.count(old) == 1
    bonn_folder(tmp_path, sensor=SENSOR.replace(old, new))
    path = tmp_path / "sensor_data.dat"
    assert_error(path, line, reason, lambda: datasets.bonn(tmp_path))


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
    bonn_folder(tmp_path, world=world)
    assert_error(tmp_path / "world.dat", line, reason, lambda: datasets.bonn(tmp_path))


@pytest.mark.parametrize("name", ["world.dat", "sensor_data.dat"])
def test_bonn_missing_file_is_named(tmp_path, name):
    (bonn_folder(tmp_path) / name).unlink()
    with pytest.raises(ValueError, match=f"{name}: cannot be read"):
        datasets.bonn(tmp_path)


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


# --- MRCLAM -----------------------------------------------------------------------------------

EPOCH = 1248272272.0
MRCLAM = {
    "Barcodes.dat": "# Subject  Barcode\n  1 \t 5\n 8 \t 70\n 6 \t 72\n",
    "Landmark_Groundtruth.dat": "# Subject x y\n 8 1.5 -2 1e-4 1e-4\n 6 0 3 1e-4 1e-4\n",
    "Robot2_Odometry.dat": """# Time v omega
1248272272.500 0.5 0.125
1248272273.000 1.0 0.000
1248272273.000 2.0 0.250
1248272274.000 0.0 0.000
""",
    "Robot2_Measurement.dat": """# Time barcode range bearing
1248272272.250 72 1.50 0.25
1248272273.500 70 2.50 -0.5
1248272273.500 5 1.00 0.0
1248272273.500 72 3.50 0.5
1248272273.500 70 2.75 -0.5
1248272274.000 99 1.00 0.0

1248272274.000 72 4.50 1.0
1248272275.000 5 1.00 0.0
""",
}


def mrclam_folder(path, name=None, text=None):
    for file, usual in MRCLAM.items():
        write(path / file, text if file == name else usual)
    return path


def test_mrclam_by_hand(tmp_path):
    data = datasets.mrclam(mrclam_folder(tmp_path), 2)
    np.testing.assert_array_equal(data.time - EPOCH, [0.25, 0.5, 1, 1.5, 2, 3])
    empty = [[0, 0], [0, 0]]
    assert_log(
        data,
        control=[
            [0, 0, 0],  # nothing is known before the first time
            [0, 0, 0.25],  # no odometry yet
            [0.5, 0.125, 0.5],
            [2, 0.25, 0.5],  # of two lines with the same time the last one holds
            [2, 0.25, 0.5],  # held from one row to the next
            [0, 0, 1],  # and after the last line
        ],
        z=[
            [[1.5, 0.25], [0, 0]],
            empty,
            empty,
            [[2.5, -0.5], [3.5, 0.5]],
            [[4.5, 1], [0, 0]],
            empty,
        ],
        tag=[[0, -1], [-1, -1], [-1, -1], [1, 0], [0, -1], [-1, -1]],
        valid=[[True, False], [False] * 2, [False] * 2, [True] * 2, [True, False], [False] * 2],
    )
    assert data.tags == (6, 8)
    assert data.dropped == {"robot sightings": 2, "unknown barcodes": 1, "repeated in a scan": 1}
    assert data.corrections == ()
    np.testing.assert_array_equal(data.landmarks, [[0, 3], [1.5, -2]])


def test_mrclam_noise_can_be_overridden(tmp_path):
    kwargs = {"odometry_cov": 3 * np.eye(2), "measurement_cov": 2 * np.eye(2)}
    data = datasets.mrclam(mrclam_folder(tmp_path), 2, **kwargs)
    np.testing.assert_array_equal(data.motion.noise_cov(jnp.zeros(3), jnp.ones(3)), 3 * np.eye(2))
    np.testing.assert_array_equal(data.sensor.noise_cov(jnp.zeros(2)), 2 * np.eye(2))


def test_white_noise_does_not_depend_on_how_time_is_cut():
    """The variance of Δt·w over an interval is that of its halves added; none, and finite, at 0."""
    noise_cov = white_noise(0.04, 0.09)

    def gained(dt):
        return dt**2 * noise_cov(jnp.zeros(3), jnp.array([1.0, 0.5, dt]))

    np.testing.assert_allclose(gained(1.0), np.diag([0.04, 0.09]), rtol=1e-14)
    np.testing.assert_allclose(gained(0.3) + gained(0.7), gained(1.0), rtol=1e-14)
    np.testing.assert_array_equal(noise_cov(jnp.zeros(3), jnp.zeros(3)), np.zeros((2, 2)))
    slope = jax.jacfwd(noise_cov, argnums=1)(jnp.zeros(3), jnp.zeros(3))
    assert np.all(np.isfinite(slope))


@pytest.mark.parametrize(
    ("name", "old", "new", "line", "reason"),
    [
        ("Robot2_Odometry.dat", "273.000 2.0", "272.999 2.0", 4, "time goes back from"),
        ("Robot2_Odometry.dat", " 2.0 0.250", " 2.0", 4, "expected 3 fields (time v omega), got 2"),
        ("Robot2_Odometry.dat", " 2.0 0.250", " v 0.250", 4, "v is not a finite number: 'v'"),
        ("Robot2_Odometry.dat", " 2.0 0.250", " 2.0 inf", 4, "omega is not a finite number"),
        ("Robot2_Odometry.dat", None, "# Time v omega\n", 1, "no data in the file"),
        ("Robot2_Odometry.dat", None, "", 1, "no data in the file"),
        ("Robot2_Measurement.dat", "273.500 5", "273.499 5", 4, "time goes back from"),
        ("Robot2_Measurement.dat", "70 2.75", "70 -2.75", 6, "the range -2.75 is negative"),
        ("Robot2_Measurement.dat", "70 2.75", "70.5 2.75", 6, "barcode is not a whole number"),
        ("Robot2_Measurement.dat", "70 2.75", "70 nan", 6, "range is not a finite number"),
        ("Robot2_Measurement.dat", "70 2.75 -0.5", "70 2.75", 6, "got 3"),
        ("Robot2_Measurement.dat", "5 1.00 0.0\n", "5 1.0", 10, "got 3"),
        ("Robot2_Measurement.dat", None, "\n\n", 2, "no data in the file"),
        ("Barcodes.dat", "8 \t 70", "8", 3, "expected 2 fields (subject barcode), got 1"),
        ("Barcodes.dat", "8 \t 70", "8 7.5", 3, "barcode is not a whole number"),
        ("Barcodes.dat", "8 \t 70", "x 70", 3, "subject is not a whole number"),
        ("Barcodes.dat", "8 \t 70", "8 5", 3, "subject 8 or barcode 5 occurs twice"),
        ("Barcodes.dat", "8 \t 70", "1 70", 3, "subject 1 or barcode 70 occurs twice"),
        ("Barcodes.dat", None, "1 5\n", 1, "no landmark in the file"),
        ("Landmark_Groundtruth.dat", "6 0 3", "6 0 y", 3, "y is not a finite number"),
        ("Landmark_Groundtruth.dat", "6 0 3", "7 0 3", 3, "subject 7 is no landmark"),
        ("Landmark_Groundtruth.dat", "6 0 3", "8 0 3", 3, "subject 8 occurs twice"),
        ("Landmark_Groundtruth.dat", " 6 0 3 1e-4 1e-4\n", "", 2, "no position of subject 6"),
        ("Landmark_Groundtruth.dat", "6 0 3 1e-4", "6 0 3", 3, "got 4"),
    ],
)
def test_mrclam_errors_say_where(tmp_path, name, old, new, line, reason):
    text = MRCLAM[name]
    assert old is None or text.count(old) in (1, 2)
    text = new if old is None else new.join(text.rsplit(old, 1))
    mrclam_folder(tmp_path, name, text)
    assert_error(tmp_path / name, line, reason, lambda: datasets.mrclam(tmp_path, 2))


@pytest.mark.parametrize("name", MRCLAM)
def test_mrclam_missing_file_is_named(tmp_path, name):
    (mrclam_folder(tmp_path) / name).unlink()
    with pytest.raises(ValueError, match=f"{name}: cannot be read"):
        datasets.mrclam(tmp_path, 2)


@pytest.mark.parametrize("robot", [0, 6, -1, 1.0, "1", True, None])
def test_mrclam_has_robots_one_to_five(tmp_path, robot):
    with pytest.raises(ValueError, match="expected a robot from 1 to 5"):
        datasets.mrclam(mrclam_folder(tmp_path), robot)


TEAM = {
    "Robot1_Odometry.dat": "1248272273.000 1.5 0.5\n1248272273.250 0 0\n",
    "Robot1_Measurement.dat": """1248272273.500 8 1.25 0.125
1248272273.500 72 4.00 0.75
1248272273.500 99 4.00 0.75
""",
}


def team_folder(path):
    for file, text in TEAM.items():
        write(path / file, text)
    barcodes = "# Subject Barcode\n 1 5\n 2 8\n 3 11\n 8 70\n 6 72\n"
    return mrclam_folder(path, "Barcodes.dat", barcodes)


def test_mrclam_team_by_hand(tmp_path):
    data = datasets.mrclam_team(team_folder(tmp_path), (2, 1))
    np.testing.assert_array_equal(data.time - EPOCH, [0.25, 0.5, 1, 1.25, 1.5, 2, 3])
    no = [0, 0]
    rows = [
        [no, no, no, no, no],
        [no, no, no, no, no],
        [no, no, no, no, no],
        [no, no, no, no, no],
        [[2.5, -0.5], [3.5, 0.5], [1, 0], [4, 0.75], [1.25, 0.125]],
        [[4.5, 1], no, no, no, no],
        [no, no, [1, 0], no, no],
    ]
    rows[0][0] = [1.5, 0.25]
    tags = np.full((7, 5), -1)
    # Robot 2's landmarks and robots, then robot 1's; tags 2 and 3 are robots 2 and 1.
    tags[0, 0] = tags[5, 0] = 0
    tags[4] = [1, 0, 3, 0, 2]
    tags[6, 2] = 3
    assert_log(
        data,
        control=[
            [0, 0, 0, 0, 0, 0],
            [0, 0, 0.25, 0, 0, 0.25],
            [0.5, 0.125, 0.5, 0, 0, 0.5],
            [2, 0.25, 0.25, 1.5, 0.5, 0.25],
            [2, 0.25, 0.25, 0, 0, 0.25],
            [2, 0.25, 0.5, 0, 0, 0.5],
            [0, 0, 1, 0, 0, 1],
        ],
        z=rows,
        tag=tags,
        valid=tags >= 0,
    )
    assert data.tags == (6, 8)
    assert data.dropped == {"robot sightings": 0, "unknown barcodes": 2, "repeated in a scan": 1}
    assert [robot.sensors.places for robot in data.robots] == [(2, 1), (1, 1)]
    assert all(robot.start is None for robot in data.robots)
    alone = datasets.mrclam_team(tmp_path, (2,))
    assert alone.dropped["robot sightings"] == 2
    assert alone.log.scan.tag.max() == 1


@pytest.mark.parametrize("robots", [(), (1, 1), (0, 1), (1, 6), (1.0,), ("1",)])
def test_mrclam_team_has_different_robots(tmp_path, robots):
    with pytest.raises(ValueError, match="expected different robots from 1 to 5"):
        datasets.mrclam_team(team_folder(tmp_path), robots)


@pytest.mark.parametrize(
    ("robot", "of_robots"), [(1, (226, 239)), (2, (324, 212)), (3, (377, 615))]
)
def test_mrclam_team_files(robot, of_robots):
    """Everything that one robot's reader gives, at the same times, and its sightings beside."""
    data, alone = mrclam_team(), mrclam(robot)
    first = sum(sum(r.sensors.places) for r in data.robots[: robot - 1])
    places, sights = data.robots[robot - 1].sensors.places
    scan, own = data.log.scan, alone.log.scan
    at = np.searchsorted(data.time, alone.time)
    np.testing.assert_array_equal(data.time[at], alone.time)
    np.testing.assert_array_equal(scan.tag[at, first : first + places], own.tag)
    np.testing.assert_array_equal(scan.z[at, first : first + places], own.z)
    assert scan.valid[:, first : first + places].sum() == own.valid.sum()
    seen = scan.tag[:, first + places : first + places + sights]
    others = [tag for tag in (15, 16, 17) if tag != 14 + robot]
    assert tuple((seen == tag).sum() for tag in others) == of_robots
    # The same travel, however time is cut; after a row of its own, the velocity is the same.
    mine = data.log.control[:, 3 * robot - 3 : 3 * robot]
    way = np.cumsum(mine[:, :2] * mine[:, 2:], axis=0)[at]
    np.testing.assert_allclose(
        way, np.cumsum(alone.log.control[:, :2] * alone.log.control[:, 2:], axis=0), atol=1e-6
    )


def raw(path):
    """A table as text fields, read without the package."""
    lines = [line.split() for line in path.read_text().splitlines()]
    return [fields for fields in lines if fields and fields[0] != "#"]


@pytest.mark.parametrize(
    ("robot", "kept", "of_robots", "unknown", "places"),
    [(1, 4771, 952, 0, 5), (2, 5543, 1156, 0, 6), (3, 6771, 1969, 2, 6)],
)
def test_mrclam_files(robot, kept, of_robots, unknown, places):
    """Counts, times, held velocities and scans against the raw files."""
    path = folder("mrclam1")
    data = mrclam(robot)
    subject_of = {b: int(s) for s, b in raw(path / "Barcodes.dat")}
    odometry = raw(path / f"Robot{robot}_Odometry.dat")
    seen = raw(path / f"Robot{robot}_Measurement.dat")
    subjects = [subject_of.get(fields[1]) for fields in seen]
    assert subjects.count(None) == unknown == data.dropped["unknown barcodes"]
    assert sum(s in range(1, 6) for s in subjects) == of_robots == data.dropped["robot sightings"]
    assert len(seen) - of_robots - unknown == kept == data.measurements
    assert data.dropped["repeated in a scan"] == 0
    assert data.tags == tuple(range(6, 21))
    assert data.steps == len({fields[0] for fields in odometry} | {fields[0] for fields in seen})
    assert data.log.scan.z.shape == (data.steps, places, 2)

    times = [float(fields[0]) for fields in odometry] + [float(fields[0]) for fields in seen]
    assert data.time[0] == min(times)
    np.testing.assert_allclose(np.cumsum(data.log.control[:, 2]), data.time - min(times), atol=1e-5)
    assert (data.log.control[:, 2] == 0).sum() == 1
    t, m = np.nonzero(data.log.scan.valid)
    scan = data.log.scan
    found = Counter(zip(data.time[t], scan.tag[t, m] + 6, scan.z[t, m, 0], strict=True))
    expected = Counter(
        (float(fields[0]), s, float(fields[2]))
        for fields, s in zip(seen, subjects, strict=True)
        if s is not None and s > 5
    )
    assert found == expected
    velocity = {float(fields[0]): (float(fields[1]), float(fields[2])) for fields in odometry}
    for row in range(1, data.steps, 997):
        latest = max((when for when in velocity if when <= data.time[row - 1]), default=None)
        assert tuple(data.log.control[row, :2]) == velocity.get(latest, (0, 0))


def test_mrclam_survey_of_data_set_1_has_two_subjects_exchanged():
    """Shown by the raw scans alone: the distance between two landmarks seen at once."""
    path = folder("mrclam1")
    subject_of = {b: int(s) for s, b in raw(path / "Barcodes.dat")}
    as_is = datasets.mrclam(path, 1, errata=False)
    corrected = mrclam(1)
    assert as_is.corrections == ()
    assert corrected.corrections == ("the surveyed positions of subjects 11 and 17 were exchanged",)
    other = [i for i, name in enumerate(as_is.tags) if name not in EXCHANGED]
    np.testing.assert_array_equal(as_is.landmarks[other], corrected.landmarks[other])

    scans = {}
    for robot in (1, 2, 3):
        for when, barcode, distance, bearing in raw(path / f"Robot{robot}_Measurement.dat"):
            polar = float(distance) * np.exp(1j * float(bearing))
            scans.setdefault((robot, when), []).append((subject_of.get(barcode), polar))
    off = {"as is": [], "corrected": [], "of the others": []}
    for scan in scans.values():
        for i, (one, a) in enumerate(scan):
            for two, b in scan[:i]:
                if one is None or two is None or min(one, two) < 6 or one == two:
                    continue
                about_them = (one in EXCHANGED) != (two in EXCHANGED)
                for name, data in (("as is", as_is), ("corrected", corrected)):
                    apart = np.linalg.norm(data.landmarks[one - 6] - data.landmarks[two - 6])
                    kind = name if about_them else "of the others"
                    off[kind].append(abs(abs(a - b) - apart))
    assert len(off["as is"]) > 1000
    assert np.median(off["as is"]) > 2
    assert np.median(off["corrected"]) < 0.15
    assert np.median(off["of the others"]) < 0.15


# --- by name ----------------------------------------------------------------------------------


def test_readers_by_name(tmp_path):
    file = write(tmp_path / "v.txt", VICTORIA)
    both = mrclam_folder(bonn_folder(tmp_path))
    for name in ("Odometry", "Measurement"):
        write(tmp_path / f"Robot1_{name}.dat", MRCLAM[f"Robot2_{name}.dat"])
    assert datasets.READERS["victoria_park"](file, None).name == "victoria_park"
    assert datasets.READERS["bonn"](str(both), None).name == "bonn"
    assert datasets.READERS["mrclam"](both, None).name == "mrclam robot 1"
    assert datasets.READERS["mrclam"](both, 2).name == "mrclam robot 2"
    for name, path in (("victoria_park", file), ("bonn", both)):
        with pytest.raises(ValueError, match="no robot 1"):
            datasets.READERS[name](path, 1)
    for name, path in (("victoria_park", file), ("bonn", both), ("mrclam", both)):
        data = datasets.READERS[name](path, None)
        assert data.source
        assert datasets.Dataset is type(data)


# --- end to end -------------------------------------------------------------------------------


def test_ekf_maps_bonn():
    data = datasets.bonn(folder("bonn"))
    info, path, final, _ = run(data)
    assert np.all(np.isfinite(path))
    assert (info.status == Status.FUSED).sum() == data.measurements - data.capacity
    assert map_rmse(final, data.landmarks) < 0.02
    assert 0.9 < nis_per_dof(info) < 1.0


@pytest.mark.parametrize(("robot", "rmse", "nis"), [(1, 0.0731, 0.775), (3, 0.1124, 0.921)])
def test_ekf_maps_mrclam(robot, rmse, nis):
    """Within 5 % of what was measured when the noise was chosen; 0.5 m was asked for."""
    data = mrclam(robot)
    info, path, final, _ = run(data)
    assert np.all(np.isfinite(path))
    assert final.alive.all()
    assert map_rmse(final, data.landmarks) < 1.05 * rmse
    assert nis_per_dof(info) == pytest.approx(nis, rel=0.05)


def test_ekf_maps_victoria_park(victoria_file):
    """All of it: finite, and the joint covariance positive definite after every step."""
    data = datasets.victoria_park(victoria_file)
    info, path, final, positive = run(data, probe=lambda s: linalg.is_positive_definite(s.cov))
    assert positive.shape == (data.steps,)
    assert positive.all()
    assert np.all(np.isfinite(path))
    assert np.all(np.isfinite(final.points))
    assert final.alive.all()
    assert (info.status == Status.BORN).sum() == 151
    assert (info.status == Status.FUSED).sum() == 3640 - 151
    assert nis_per_dof(info) == pytest.approx(0.912, abs=0.005)
