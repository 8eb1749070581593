"""`datasets.table`: little files by hand, settings and their defaults, and errors that say where."""

import gzip
import re
from pathlib import Path

import chex
import numpy as np
import pytest
from recordings import write

from jaxslam import datasets, stats
from jaxslam.core.types import Estimate
from jaxslam.datasets._evaluation import evaluate

OWN = {
    "odometry.csv": "t [s],v [m/s],omega [rad/s]\n1.0,0.5,0.1\n1.2,1.0,0\n1.4,0,0\n",
    "measurements.csv": "t [s],tag,range [m],bearing [rad]\n1.1,7,2,0.25\n1.1,3,3,-0.5\n1.4,3,4,0.5\n",
}
TRUTH = {
    "truth.csv": "t [s],x [m],y [m],theta [rad]\n0.9,1,2,0\n1.3,1.4,2,0.4\n1.4,2,2,0.5\n",
    "landmarks.csv": "tag,x [m],y [m]\n7,3,2\n9,0,0\n3,1,5\n",
}
SETTINGS = {
    "dataset.toml": """
name = "robot"
[motion]
model = "unicycle"
noise = [0.02, 0.01]
[sensor]
model = "range_bearing"
noise = [0.05, 0.02]
mount = [0.1, 0, 0]
[filter]
gate = 0.999
capacity = 5
start = [1, 2, 0.5]
start_noise = [0.1, 0.2, 0.3]
update = "joint"
associate = "known"
"""
}
U = np.array([0.5, 0.1, 0.05])


def test_a_table_by_hand_with_every_setting(tmp_path):
    data = datasets.table(write(tmp_path, OWN | SETTINGS))
    np.testing.assert_array_equal(data.time, [1.0, 1.1, 1.2, 1.4])
    np.testing.assert_allclose(
        data.log.control,
        [[0, 0, 0], [0.5, 0.1, 0.1], [0.5, 0.1, 0.1], [1, 0, 0.2]],
        atol=1e-15,
    )
    np.testing.assert_array_equal(data.log.scan.tag[1], [1, 0])
    assert (data.name, data.tags, data.capacity) == ("robot", (3, 7), 5)
    # A line of odometry is 0.2 s; a quarter of it has four times the variance.
    noise = data.motion.noise_cov(np.zeros(3), U)
    np.testing.assert_allclose(noise, 4 * np.diag([0.02, 0.01]) ** 2, rtol=1e-12)
    assert not np.any(data.motion.noise_cov(np.zeros(3), 0 * U))
    np.testing.assert_allclose(data.sensor.noise_cov(np.zeros(2)), np.diag([0.05, 0.02]) ** 2)
    np.testing.assert_allclose(data.sensor.observe(np.zeros(3), np.array([2.1, 0])), [2, 0])
    assert data.filter_options == {"correction": "joint", "gate": stats.chi2_quantile(0.999, 2)}
    np.testing.assert_array_equal(data.pose, [1, 2, 0.5])
    np.testing.assert_allclose(data.pose_cov, np.diag([0.01, 0.04, 0.09]))
    assert data.one_frame
    assert data.assumed == ()


def test_defaults_are_listed(tmp_path):
    data = datasets.table(write(tmp_path, OWN))
    assert (data.motion.name, data.sensor.name) == ("unicycle", "range_bearing")
    assert not data.one_frame
    assert data.assumed == (
        "no dataset.toml",
        '[motion] model = "unicycle"',
        "[motion] noise = [0.1, 0.1] (v [m/s], omega [rad/s])",
        '[sensor] model = "range_bearing"',
        "[sensor] noise = [0.1, 0.05] (range [m], bearing [rad])",
        "[sensor] mount = [0.0, 0.0, 0.0]",
        "[filter] capacity = 2",
        "[filter] start_noise = [0.0, 0.0, 0.0]",
        '[filter] update = "sequential"',
        '[filter] associate = "known"',
        "[filter] gate: none",
        "[filter] start = [0.0, 0.0, 0.0]",
    )


def test_windows_lines_degrees_and_other_columns(tmp_path):
    """The same numbers: a byte order mark, CRLF, [deg], blanks, columns moved and one too many,
    quotes, and comments above the header, one with a quote that is not closed."""
    plain = datasets.table(write(tmp_path, OWN))
    text = "tag, bearing [deg],note, t [ms] ,range [m]\r\n7,14.323944878270581,a,1100,2\r\n\r\n"
    text += "3,-28.64788975654116,b,1100,3\r\n3,28.64788975654116,c,1400,4"
    (tmp_path / "measurements.csv").write_bytes(b"\xef\xbb\xbf" + text.encode())
    odometry = OWN["odometry.csv"].replace("\n1.0,0.5,", '\n"1.0","0.5",')
    (tmp_path / "odometry.csv").write_text('# my robot\n\n# on "Monday,"half\n' + odometry)
    data = datasets.table(tmp_path)
    chex.assert_trees_all_close(data.log, plain.log, rtol=1e-14, atol=1e-15)
    assert "column 'note' of measurements.csv is not used" in data.assumed


def test_a_gap_in_the_odometry_is_noted(tmp_path):
    """Over which the last velocity holds, or poses are interpolated."""
    late = OWN["odometry.csv"] + "1.6,0,0\n61.6,0,0\n"
    data = datasets.table(write(tmp_path, OWN, "odometry.csv", late))
    (note,) = (line for line in data.assumed if "since the line before" in line)
    assert note.startswith(f"{tmp_path / 'odometry.csv'}:6: column 1 (t [s]): 60 s since")


def test_packed_tables_are_read_as_they_are(tmp_path):
    """The same data set, and an error that names the packed file."""
    plain = datasets.table(write(tmp_path, OWN | TRUTH))
    for name in OWN | TRUTH:
        (tmp_path / f"{name}.gz").write_bytes(gzip.compress((tmp_path / name).read_bytes()))
        (tmp_path / name).unlink()
    data = datasets.table(tmp_path)
    assert (data.tags, data.assumed) == (plain.tags, plain.assumed)
    for name in ("log", "pose", "landmarks", "true_path"):
        chex.assert_trees_all_equal(getattr(data, name), getattr(plain, name))
    spoiled = OWN["odometry.csv"].replace("1.2,1.0", "1.2,nan").encode()
    (tmp_path / "odometry.csv.gz").write_bytes(gzip.compress(spoiled))
    place = re.escape(f"{tmp_path / 'odometry.csv.gz'}:3: column 2 (v [m/s]): expected a finite")
    with pytest.raises(ValueError, match=place):
        datasets.table(tmp_path)


def test_the_truth_gives_the_start_and_the_frame(tmp_path):
    data = datasets.table(write(tmp_path, OWN | TRUTH))
    np.testing.assert_allclose(data.pose, [1.1, 2, 0.1])
    np.testing.assert_allclose(data.true_path[:, 0], [1.1, 1.2, 1.3, 2])
    assert data.one_frame
    assert data.true_at.all()
    assert data.tags == (3, 7, 9)
    np.testing.assert_array_equal(data.landmarks, [[1, 5], [3, 2], [0, 0]])
    late = TRUTH["truth.csv"].replace("0.9", "1.15")
    data = datasets.table(write(tmp_path, OWN | TRUTH, "truth.csv", late))
    assert not data.one_frame
    np.testing.assert_array_equal(data.true_at, [False, False, True, True])
    np.testing.assert_array_equal(data.pose, 0)


def test_poses_become_increments_with_an_interval(tmp_path):
    """Their noise is that of a line, in proportion where a measurement divides it."""
    path = "t [s],x [m],y [m],theta [deg]\n1,0,0,0\n1.2,1,0,90\n1.4,1,1,90\n"
    toml = "[motion]\nnoise = [0.1, 0.2, 0.3]\n"
    data = datasets.table(write(tmp_path, OWN | {"odometry.csv": path, "dataset.toml": toml}))
    assert data.motion.name == "pose_increment"
    expected = [[0, 0, 0, 0], [0.5, 0, np.pi / 4, 0.1], [0, 0, 0, 0.1], [1, 0, 0, 0.2]]
    c = 0.5 * np.sqrt(0.5)
    expected[2][:3] = [c, -c, np.pi / 4]
    np.testing.assert_allclose(data.log.control, expected, atol=1e-12)
    pose = np.zeros(3)
    for u in data.log.control:
        pose = data.motion.step(pose, u, np.zeros(3))
    np.testing.assert_allclose(pose, [1, 1, np.pi / 2], rtol=1e-6)
    cov = np.diag([0.1, 0.2, 0.3]) ** 2
    for row, part in enumerate((0, 0.5, 0.5, 1)):
        found = data.motion.noise_cov(pose, data.log.control[row])
        np.testing.assert_allclose(found, part * cov, atol=1e-12, rtol=1e-6)


def test_unknown_tags_have_an_association_and_room(tmp_path):
    data = datasets.table(
        write(tmp_path, OWN, "measurements.csv", OWN["measurements.csv"].replace(",7,", ",,"))
    )
    assert data.log.scan.tag[1].tolist() == [-1, 0]
    assert (data.tags, data.capacity) == ((3,), 101)
    assert callable(data.filter_options["associate"])
    assert '[filter] associate = "nearest"' in data.assumed
    assert "[filter] gate = 0.99" in data.assumed


@pytest.mark.parametrize(
    ("columns", "model"),
    [
        ("range [m]", "range_only"),
        ("bearing [rad]", "bearing_inverse_depth"),
        ("ahead [m],left [m]", "relative_position"),
        ("range [m],bearing [rad],signature [1]", "range_bearing_signature"),
        ("heading [rad]", "compass"),
    ],
)
def test_the_columns_choose_the_model(tmp_path, columns, model):
    text = f"t [s],tag,{columns}\n1.1,7{',1' * len(columns.split(','))}\n"
    data = datasets.table(write(tmp_path, OWN, "measurements.csv", text))
    assert data.sensor.name == model
    assert data.measurements == 1


ODOMETRY, SEEN = "odometry.csv", "measurements.csv"
BAD = [
    (ODOMETRY, "v [m/s]", "speed [m/s]", ":1: expected a column 'v [m/s]' (of the motion model unicycle)"),
    (ODOMETRY, "v [m/s]", "v", ":1: column 2 (v): expected a unit [m/s], got 'v'"),
    (ODOMETRY, "[rad/s]", "[rpm]", ":1: column 3 (omega [rpm]): expected a unit [rad/s] or [deg/s]"),
    (ODOMETRY, "omega [rad/s]", "v [m/s]", ":1: column 3 (v [m/s]): the column 'v' occurs twice"),
    (ODOMETRY, "1.2,", "0.9,", ":3: column 1 (t [s]): expected a time above 1.0, got 0.9"),
    (ODOMETRY, "1.2,", "1.0,", ":3: column 1 (t [s]): expected a time above 1.0, got 1.0"),
    (ODOMETRY, "1.2,1.0", "1.2,nan", ":3: column 2 (v [m/s]): expected a finite number, got 'nan'"),
    (ODOMETRY, "1.2,1.0", "1.2,1e99", ":3: column 2 (v [m/s]): expected a number within ±1e+60, got '1e99'"),
    (ODOMETRY, "1.2,1.0", "1.2,", ":3: column 2 (v [m/s]): expected a finite number, got ''"),
    (ODOMETRY, "1.2,1.0", "1.2,1_0", ":3: column 2 (v [m/s]): expected a finite number, got '1_0'"),
    (ODOMETRY, "1.2,1.0", '1.2,"1,0"', ":3: column 2 (v [m/s]): expected a finite number, got '1,0' (w"),
    (ODOMETRY, "1.2,1.0", "1,2,1,0", ":3: expected 3 cells, as in line 1, got 5; write a number with a point"),
    (ODOMETRY, "1.2,1.0,0", "1.2,1.0", ":3: expected 3 cells, as in line 1, got 2"),
    (ODOMETRY, None, "", ":1: expected a header"),
    (ODOMETRY, "t [s]", "# by robot\n1,2,3\n# t [s]", ":2: expected a header, as 't [s],v [m/s]', got '1'"),
    (ODOMETRY, "t [s]", "sep=,\nt [s]", ":2: expected 2 cells, as in line 1, got 3"),
    (ODOMETRY, None, "t [s],v [m/s],omega [rad/s]\n", ":1: expected lines below the header, got none"),
    (ODOMETRY, None, "t [s];v [m/s];omega [rad/s]\n1;2;3\n", ":1: expected cells separated by commas, got ';'"),
    (SEEN, "1.4,3", "0.4,3", ":4: column 1 (t [s]): expected a time of at least 1.1"),
    (SEEN, "1.4,3", "1.4,3.5", ":4: column 2 (tag): expected a whole number >= 0, or nothing if"),
    (SEEN, "1.4,3", "1.4,tree", ":4: column 2 (tag): expected a whole number"),
    (SEEN, "1.4,3", "1.1,3", ":4: column 2 (tag): expected a tag once at a time, got 3 twice"),
    (SEEN, "tag,", "id,", ":1: expected a column 'tag' (of the sensor range_bearing), got 't [s]'"),
    ("truth.csv", "1.3,", "0.8,", ":3: column 1 (t [s]): expected a time above 0.9, got 0.8"),
    ("truth.csv", None, "t [s],x [m],y [m],theta [rad]\n5,0,0,0\n", ": expected times within those"),
    ("landmarks.csv", "9,0,0", "7,0,0", ":3: column 1 (tag): expected a tag that no other line has, got 7 again"),
    ("landmarks.csv", "9,0,0\n3,1,5", "\v9,0,0\n7,1,5", ":4: column 1 (tag): expected a tag that no other line has"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "old", "new", "reason"), BAD)
def test_a_bad_table_says_where(tmp_path, name, old, new, reason):
    files = (
        OWN
        | TRUTH
        | {"dataset.toml": "[motion]\nmodel = 'unicycle'\n[sensor]\nmodel = 'range_bearing'"}
    )
    assert old is None or old in files[name]
    write(tmp_path, files, name, new if old is None else files[name].replace(old, new, 1))
    with pytest.raises(ValueError) as caught:  # noqa: PT011 the message is compared below
        datasets.table(tmp_path)
    assert str(caught.value).startswith(f"{tmp_path / name}:")
    assert reason in str(caught.value)


def test_a_measured_tag_that_was_not_surveyed_is_shown(tmp_path):
    write(tmp_path, OWN | TRUTH, "landmarks.csv", TRUTH["landmarks.csv"].replace("7,3,2\n", ""))
    with pytest.raises(ValueError) as caught:  # noqa: PT011 the message is compared below
        datasets.table(tmp_path)
    place = f"{tmp_path / SEEN}:2: column 2 (tag): "
    assert str(caught.value) == f"{place}expected a tag of landmarks.csv, got 7"


@pytest.mark.parametrize("name", OWN)
def test_a_file_that_is_missing_or_no_text_is_named(tmp_path, name):
    write(tmp_path, OWN)
    for content in (b"t [s]\n\xff\n1\n", b"t\n\0\n"):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=f"{name}:2: expected text"):
            datasets.table(tmp_path)
    (tmp_path / name).unlink()
    with pytest.raises(ValueError, match=f"expected a file {name}, with columns 't"):
        datasets.table(tmp_path)
    for wrong, found in ((tmp_path / name, "does not exist"), (Path(__file__), "is a file")):
        with pytest.raises(
            ValueError, match=rf"{wrong.name} {found}: expected a folder with odome"
        ):
            datasets.table(wrong)


@pytest.mark.parametrize(
    ("toml", "reason"),
    [
        ("[motion]\nmodel = 'tank'", "[motion] model: expected one of ackermann, increment, odometry"),
        ("[sensor]\nmodel = 'eye'", "[sensor] model: expected one of bearing_inverse_depth, bearing"),
        ("[motion]\nnoise = [0.1]", "[motion] noise: expected 2 numbers (v [m/s], omega [rad/s])"),
        ("[motion]\nnoise = [0.1, -1]", "[motion] noise: expected standard deviations >= 0"),
        ("[sensor]\nnoise = [0.1, 0]", "[sensor] noise: expected numbers above 0"),
        ("[sensor]\nnoise = [0.1, nan]", "[sensor] noise: expected 2 numbers"),
        ("[sensor]\nmount = [1, 2]", "[sensor] mount: expected 3 numbers (x [m], y [m], theta [rad])"),
        ("[sensor]\nheight = 2", "[sensor] height: expected one of model, noise, mount"),
        ("[filter]\ngate = 9.2", "[filter] gate: expected a probability between 0 and 1, got 9.2"),
        ("[filter]\ncapacity = 1", "[filter] capacity: expected a whole number of at least 2"),
        ("[filter]\nstart = [0, 0]", "[filter] start: expected 3 numbers (x [m], y [m], theta [rad])"),
        ("[filter]\nstart_noise = [0, 0, -1]", "[filter] start_noise: expected numbers of at least"),
        ("[filter]\nassociate = 'best'", "[filter] associate: expected one of nearest, global_near"),
        ("[filter]\nupdate = 'batch'", '[filter] update: expected "sequential" or "joint"'),
        ("[robot]\nmass = 1", ":1: robot: expected one of name, source, motion, sensor, filter"),
        ("filter = 3", ":1: filter: expected a section [filter]"),
        ("# mine\n[sensor]\n[motion]\nnoise = [1]", ":4: [motion] noise: expected 2 numbers"),
        ("[motion\n", "expected TOML: Expected ']'"),
    ],
)  # fmt: skip
def test_bad_settings_are_named(tmp_path, toml, reason):
    with pytest.raises(ValueError) as caught:  # noqa: PT011 the message is compared below
        datasets.table(write(tmp_path, OWN | {"dataset.toml": toml}))
    assert str(caught.value).startswith(f"{tmp_path / 'dataset.toml'}:")
    assert (f":2: {reason}" if reason[0] == "[" else reason) in str(caught.value)


@pytest.mark.parametrize(
    ("toml", "reason"),
    [
        ("[[motion]]\nnoise = [0.1, 0.1]\n", r"expected a section \[motion\]"),
        ("[motion]\nscale = " + 5000 * "9", "cannot be read: Exceeds the limit"),
    ],
)
def test_bad_files_of_fitted_numbers_are_named(tmp_path, toml, reason):
    write(tmp_path, OWN | {"fit.toml": toml})
    with pytest.raises(ValueError, match=rf"fit\.toml: {reason}"):
        datasets.table(tmp_path)


def test_columns_of_no_model_list_those_of_all(tmp_path):
    with pytest.raises(ValueError, match=r"no model has the columns t \[s\], speed.*unicycle \(v"):
        datasets.table(write(tmp_path, OWN, ODOMETRY, 't [s],"speed\u2028[m/s]"\n1,1\n'))


def estimates(data, shift):
    """A path and map off the truth by `shift` metres in x, with a covariance of 0.01."""
    count = data.capacity
    path = Estimate(
        data.true_path + [shift, 0, 0], np.tile(0.01 * np.eye(3), (4, 1, 1)), (), (), (), ()
    )
    tag = np.array([2, 0, -1])
    points = np.where(tag[:, None] < 0, 0, data.landmarks[tag]) + [shift, 0]
    covs = np.tile(0.01 * np.eye(2), (count, 1, 1))
    return path, Estimate(path.pose[-1], path.pose_cov[-1], points, covs, tag >= 0, tag)


def test_errors_against_the_truth_by_hand(tmp_path):
    data = datasets.table(write(tmp_path, OWN | TRUTH))
    found = evaluate(data, *estimates(data, 0.2))
    expected = {
        "ATE [m]": 0.2,
        "heading RMSE [°]": 0.0,
        "pose NEES, mean (3 is honest)": 4.0,
        "pose NEES, median (2.37 is honest)": 4.0,
        "map RMSE [m]": 0.2,
        "landmark NEES (2 is honest)": 4.0,
    }
    assert found.errors.keys() == expected.keys()
    np.testing.assert_allclose(list(found.errors.values()), list(expected.values()), atol=1e-12)


def test_errors_in_frames_of_their_own_are_taken_after_an_alignment(tmp_path):
    late = TRUTH["truth.csv"].replace("0.9", "1.05")
    data = datasets.table(write(tmp_path, OWN | TRUTH, "truth.csv", late))
    found = evaluate(data, *estimates(data, 0.2))
    assert list(found.errors) == [
        "ATE after alignment [m]",
        "heading RMSE after alignment [°]",
        "map RMSE after alignment [m]",
        "landmark NEES after alignment (honest: below 2)",
    ]
    np.testing.assert_allclose(list(found.errors.values()), 0, atol=1e-5)
    assert found.path.shape == (3, 3)


def test_a_relative_error_by_hand(tmp_path):
    """Of poses 1 s apart: the second is 0.3 m ahead of the truth, in the frame of the first."""
    lines = "t [s],x [m],y [m],theta [rad]\n1,0,0,0\n2,1,0,0\n3,2,0,0\n"
    odometry = "t [s],v [m/s],omega [rad/s]\n1,1,0\n2,1,0\n3,1,0\n"
    seen = "t [s],tag,range [m],bearing [rad]\n2,7,1,0\n"
    data = datasets.table(
        write(tmp_path, {"odometry.csv": odometry, "measurements.csv": seen, "truth.csv": lines})
    )
    pose = np.array([[0, 0, np.pi / 2], [0, 1.3, np.pi / 2], [0, 2.3, np.pi / 2]])
    path = Estimate(pose, np.zeros((3, 3, 3)), (), (), (), ())
    empty = Estimate(
        pose[-1],
        np.zeros((3, 3)),
        np.zeros((1, 2)),
        np.zeros((1, 2, 2)),
        np.zeros(1, bool),
        -np.ones(1, int),
    )
    errors = evaluate(data, path, empty).errors
    np.testing.assert_allclose(errors["RPE over 1 s [m]"], 0.3 / np.sqrt(2))
    assert "pose NEES, mean (3 is honest)" not in errors


def test_a_jump_of_the_odometry_is_no_motion(tmp_path):
    """Poses begin again at zero, at line 32 of the file."""
    t = 0.2 * np.arange(50)
    path = np.column_stack([5 + 0.1 * np.arange(50), 0 * t, 0 * t])
    path[30:] -= path[30]
    rows = "".join(
        f"{a:.1f},{x:.6f},{y:.6f},{h:.6f}\n" for a, (x, y, h) in zip(t, path, strict=True)
    )
    files = {
        "odometry.csv": "t [s],x [m],y [m],theta [rad]\n" + rows,
        "measurements.csv": "t [s],tag,range [m],bearing [rad]\n1.0,7,2,0.25\n",
    }
    data = datasets.table(write(tmp_path, files))
    np.testing.assert_allclose(data.log.control[1:, :3], np.tile([0.1, 0, 0], (49, 1)), atol=1e-6)
    told = [text for text in data.assumed if "a jump of the odometry" in text]
    assert len(told) == 1 and "odometry.csv:32" in told[0] and "by 7.9 m and 0°" in told[0]
