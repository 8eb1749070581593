"""`datasets.table`: little files by hand, settings and their defaults, and errors that say where."""

import gzip
import re
from pathlib import Path

import chex
import jax
import numpy as np
import pytest
from recordings import write

import jaxslam
from jaxslam import datasets
from jaxslam.association import Nearest
from jaxslam.core.types import Estimate
from jaxslam.datasets import evaluate
from jaxslam.math.numpy_poses import compose

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
    assert data.filter_options == {"correction": "joint", "gate": 0.999}
    np.testing.assert_array_equal(data.pose, [1, 2, 0.5])
    np.testing.assert_allclose(data.pose_cov, np.diag([0.01, 0.04, 0.09]))
    assert data.one_frame
    assert data.assumed == ()


def test_gates_births_a_share_of_the_range_and_a_start_that_is_correlated(tmp_path):
    settings = """
[sensor]
noise = [0, 0.02]
share = 0.1
[filter]
associate = "nearest"
gate = 0.9
new_gate = 0.95
births = 2
start_covariance = [[0.04, 0.01, 0], [0.01, 0.04, 0], [0, 0, 0.09]]
"""
    data = datasets.table(write(tmp_path, OWN | {"dataset.toml": settings}))
    cov = data.sensor.noise_cov(np.array([2.0, 0.3]))
    np.testing.assert_allclose(cov, np.diag([0.2, 0.02]) ** 2, rtol=1e-12)
    np.testing.assert_array_equal(data.pose_cov, [[0.04, 0.01, 0], [0.01, 0.04, 0], [0, 0, 0.09]])
    rule = data.filter_options.pop("associate")
    assert (type(rule), rule.gate, rule.new_gate) == (Nearest, 0.9, 0.95)
    assert data.filter_options == {"correction": "sequential", "births": 2}
    for old, new, reason in (
        ("new_gate = 0.95", "new_gate = 0.8", "new_gate: expected at least gate = 0.9, got 0.8"),
        ("births = 2", "start_noise = [0, 0, 0]", "start_covariance: expected no start_noise"),
        ("[[0.04, 0.01, 0]", "[[0.04, 0.02, 0]", "start_covariance: expected a covariance"),
    ):
        changed = {"dataset.toml": settings.replace(old, new)}
        with pytest.raises(ValueError, match=reason):
            datasets.table(write(tmp_path, OWN | changed))


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
    ("truth.csv", "1.3,1.4", "1.3,inf", ":3: column 2 (x [m]): expected a finite number, got 'inf'"),
    ("truth.csv", "1.3,1.4", "nan,1.4", ":3: column 1 (t [s]): expected a finite number, got 'nan'"),
    (ODOMETRY, "1.2,1.0", "1,2,1,0", ":3: expected 3 cells, as in line 1, got 5; write a number with a point"),
    (ODOMETRY, "1.2,1.0,0", "1.2,1.0", ":3: expected 3 cells, as in line 1, got 2"),
    (ODOMETRY, None, "", ":1: expected a header"),
    (ODOMETRY, "t [s]", "# by robot\n1,2,3\n# t [s]", ":2: expected a header, as 't [s],v [m/s]', got '1'"),
    (ODOMETRY, "t [s]", "sep=|\nt [s]", ":1: expected sep= and , or ; or a tab, got '|'"),
    (ODOMETRY, "t [s],v", "t [s];,v", ":1: expected one separator of cells in the header, got ',' and ';'"),
    (ODOMETRY, "1.2,1.0", '1.2,"1,200.5"', ":3: column 2 (v [m/s]): expected a finite number, got '1,200.5' (write a p"),
    (ODOMETRY, None, "t [s];v [m/s];omega [rad/s]\n1;1,250;2\n2;1,500;3\n", ":2: column 2 (v [m/s]): expected a finite number, got '1,250' (decimals or thousands?"),
    (ODOMETRY, None, "t [s];v [m/s];omega [rad/s]\n1;1.250;2\n2;1.500;3\n", ":2: column 2 (v [m/s]): expected a finite number, got '1.250' (decimals or thousands?"),
    (ODOMETRY, None, "t [s];v [m/s];omega [rad/s]\n1;0,25;2\n2;1.500;3\n", ":2: column 2 (v [m/s]): expected a finite number, got '0,25' (write a point"),
    (ODOMETRY, None, "t [s];v [m/s];omega [rad/s]\n1;1.250,5;0,1\n", ":2: column 2 (v [m/s]): expected a finite number, got '1.250,5' (write a point"),
    (ODOMETRY, None, "t [s];v [m/s];omega [rad/s]\n1;2;3;4\n", ":2: expected 3 cells, as in line 1, got 4"),
    (ODOMETRY, None, "t [s],v [m/s],omega [rad/s]\n", ":1: expected lines below the header, got none"),
    (ODOMETRY, None, "t [s]|v [m/s]|omega [rad/s]\n1|2|3\n", ":1: column 1 (t [s]|v [m/s]|omega [rad/s]): expected a unit [s]"),
    (ODOMETRY, "t [s]", "t [min]", ":1: column 1 (t [min]): expected a unit [s] or [ms] or [us] or [ns], got"),
    (SEEN, "1.4,3", "0.4,3", ":4: column 1 (t [s]): expected a time of at least 1.1"),
    (SEEN, "1.4,3", "1.4,3.5", ":4: column 2 (tag): expected a whole number >= 0, or nothing if"),
    (SEEN, "1.4,3", "1.4,inf", ":4: column 2 (tag): expected a whole number >= 0, or nothing if"),
    (SEEN, "1.4,3", '1.4,"3,000"', ":4: column 2 (tag): expected a whole number >= 0, or nothing if"),
    (SEEN, "1.4,3", '1.4,"a\nb"', ":4: column 2 (tag): expected a name of at most 100 characters in one line"),
    (SEEN, "1.4,3", "1.4,tree", ":4: column 2 (tag): expected a tag of landmarks.csv, got tree"),
    (SEEN, "range [m],bearing [rad]\n1.1,7,2,0.25\n1.1,3,3,-0.5\n1.4,3,4,0.5", "range [m],bearing [rad]\n1.1,7,-2,0\n1.2,7,-1,0\n9,7,2,0", ":2: no measurement is left, of 1 measurements outside the odometry, 2 measurements with a range below 0"),
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
        ("[motion]\nmodel = 'tank'", '[motion] model: expected "ackermann" or "biased_odometry" or "constant_'),
        ("[sensor]\nmodel = 'eye'", '[sensor] model: expected "bearing_inverse_depth" or "bearing'),
        ("[motion]\nnoise = [0.1]", "[motion] noise: expected 2 numbers (v [m/s], omega [rad/s])"),
        ("[motion]\nnoise = [0.1, -1]", "[motion] noise: expected numbers >= 0, got [0.1, -1.0]"),
        ("[sensor]\nnoise = [0.1, 0]", "[sensor] noise: expected numbers above 0"),
        ("[sensor]\nnoise = [0.1, nan]", "[sensor] noise: expected 2 numbers"),
        ("[sensor]\nmount = [1, 2]", "[sensor] mount: expected 3 numbers (x [m], y [m], theta [rad])"),
        ("[sensor]\nheight = 2", "[sensor] height: expected one of model, noise, across, mount"),
        ("[filter]\ngate = 9.2", "[filter] gate: expected a probability above 0 and below 1, as 0.999, got 9.2 "),
        ("[filter]\ncapacity = 1", "[filter] capacity: expected at least 2, the number of tags, got 1"),
        ("[filter]\nstart = [0, 0]", "[filter] start: expected 3 numbers (x [m], y [m], theta [rad])"),
        ("[filter]\nstart_noise = [0, 0, -1]", "[filter] start_noise: expected numbers >= 0"),
        ("[filter]\nstart_covariance = [1, 2, 3]", "[filter] start_covariance: expected 3 numbers"),
        ("[filter]\nstart_covariance = 3", "[filter] start_covariance: expected 3 rows of numbers"),
        ("[filter]\nbirths = 0", "[filter] births: expected an integer >= 1, got 0"),
        ("[filter]\nnew_gate = 0.99", "[filter] new_gate: expected none of known tags, got 0.99"),
        ("[sensor]\nshare = -1", "[sensor] share: expected a number >= 0, got -1"),
        ("[filter]\nassociate = 'best'", '[filter] associate: expected "nearest" or "global_near'),
        ("[filter]\nupdate = 'batch'", '[filter] update: expected "sequential" or "joint"'),
        ("[robot]\nmass = 1", ":1: robot: expected one of name, source, motion, sensor, filter"),
        ("filter = 3", ":1: filter: expected a section [filter]"),
        ("# mine\n[sensor]\n[motion]\nnoise = [1]", ":4: [motion] noise: expected 2 numbers"),
        ("[motion\n", "expected TOML: Expected ']'"),
        ("[motion]\nmodel = 'ackermann'\nwheelbase = -1", ":3: [motion] wheelbase: expected a number above 0, got -1"),
        ("[sensor]\nacross = 0.1\naxis = 'x'", ":3: [sensor] axis: expected 1 number ([rad]), got 'x'"),
        ("[calibration]\nparameters = [[1]]", "[calibration] parameters: expected some of motion v [m/s]"),
        ("name = 3", ":1: name: expected a str, got 3"),
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
        ("[[motion]]\nnoise = [0.1, 0.1]\n", r"motion: expected a section \[motion\]"),
        ("[motion]\nscale = " + 5000 * "9", "cannot be read: Exceeds the limit"),
        ("[sensor]\n[motion]\nnoise = [0.1]", r"3: \[motion\] noise: expected 2 numbers"),
        ("[robot]\nmass = 1", r"1: robot: expected one of name, source, motion"),
    ],
)
def test_bad_files_of_fitted_numbers_are_named(tmp_path, toml, reason):
    write(tmp_path, OWN | {"fit.toml": toml})
    with pytest.raises(ValueError, match=rf"fit\.toml: ?{reason}"):
        datasets.table(tmp_path)


def test_the_page_has_the_keys_that_the_settings_have(tmp_path):
    """An unknown key is refused with those of its section; the page adds nothing and lacks none."""
    page = (Path(__file__).parents[2] / "docs/guide/own_data.md").read_text()
    pages: dict[str, set[str]] = {section: set() for section in ("motion", "sensor", "filter", "state", "calibration")}  # fmt: skip
    section = None
    for row in page.splitlines():
        cell = row.split("|")[1] if row.startswith("| `") else ""
        heading = re.search(r"\[(\w+)\]", cell)
        if heading or section == "state":
            pages[heading[1] if heading else "state"] |= set(re.findall(r"`(?:\[\w+\] )?(\w+)`", cell))  # fmt: skip
        if not cell and not row.startswith("|---"):
            section = "state" if row.startswith("| key of `[state]`") else None
    for name, keys in pages.items():
        toml = f"[{name}]\nbogus = 1"
        with pytest.raises(ValueError, match=r"bogus: expected one of") as caught:
            datasets.table(write(tmp_path, OWN | {"dataset.toml": toml}))
        listed = str(caught.value).partition("one of ")[2].partition(", the keys of")[0]
        assert keys == set(listed.split(", "))


def test_columns_of_no_model_list_those_of_all(tmp_path):
    with pytest.raises(ValueError, match=r"no model has the columns t \[s\], speed.*unicycle \(v"):
        datasets.table(write(tmp_path, OWN, ODOMETRY, 't [s],"speed\u2028[m/s]"\n1,1\n'))


DRIVE = np.arange(301) / 10
CIRCLE = np.stack([np.sin(0.3 * DRIVE), 1 - np.cos(0.3 * DRIVE), 0.3 * DRIVE], axis=1)
"""Times and poses of a robot on a circle of 1 m, 0.3 rad/s."""


def on_a_circle(folder, truth=CIRCLE, header="t [s],x [m],y [m],theta [rad]", **files):
    """The folder of this drive, with odometry of velocities, or the files given by name."""

    def table(head, *columns):
        rows = (",".join(map("{:.9g}".format, row)) for row in np.column_stack(columns))
        return "\n".join([head, *rows]).replace("nan", "") + "\n"

    every = {
        "odometry": table("t [s],v [m/s],omega [rad/s]", DRIVE, np.tile([0.3, 0.3], (301, 1))),
        "measurements": "t [s],tag,range [m],bearing [rad]\n0.5,7,2,0.25\n14.95,7,2,1\n25,7,3,1\n",
        "truth": table(header, DRIVE, truth) if isinstance(truth, np.ndarray) else truth,
    }
    folder.mkdir(exist_ok=True)
    return write(folder, {f"{name}.csv": text for name, text in (every | files).items()})


HOLES = {
    "a hole": (slice(100, 200), None, range(100, 200)),
    "two holes and late": ([*range(20), *range(50, 80), *range(200, 301)], None, [*range(20), *range(50, 80), *range(200, 301)]),
    "no heading": (slice(0), slice(100, 103), [*range(100, 103)]),
    "a tenth of the rate": ([k for k in range(301) if k % 10], None, []),
    "a tenth of the rate and a hole": ([k for k in range(301) if k % 10 or 50 < k < 170], None, range(51, 170)),
}  # fmt: skip


@pytest.mark.parametrize("name", HOLES)
def test_no_true_pose_is_interpolated_over_a_hole(tmp_path, name):
    """Before the first line, after the last, over ten intervals, or beside a line without a pose."""
    absent, empty, unknown = HOLES[name]
    truth = CIRCLE.copy()
    if empty is not None:
        truth[empty, 2] = np.nan
    lines = on_a_circle(tmp_path, truth).joinpath("truth.csv").read_text().splitlines()
    kept = np.delete(np.arange(301), absent)
    (tmp_path / "truth.csv").write_text("\n".join([lines[0], *(lines[1 + k] for k in kept)]))
    data = datasets.table(tmp_path)
    known = ~np.isin(data.time, DRIVE[list(unknown)])
    # The row between two lines of the odometry, at 14.95 s, has a pose if both of these have.
    known[data.time == 14.95] = not {149, 150} & {*unknown}
    np.testing.assert_array_equal(data.true_at, known)
    assert data.rows_without_truth == (~known).sum()
    exact = np.stack([np.sin(0.3 * data.time), 1 - np.cos(0.3 * data.time)], axis=1)
    np.testing.assert_allclose(data.true_path[known, :2], exact[known], atol=0.02)
    assert np.isnan(data.true_path[~known]).all()
    said = [note for note in data.assumed if "have no true pose" in note]
    assert [note.split(" rows")[0] for note in said] == (
        [f"{(~known).sum()} of {len(known)}"] if unknown else []
    )
    assert any("no pose is interpolated over it" in note for note in data.assumed) == (
        "hole" in name
    )
    assert any("1 of" not in n and "lines have no pose" in n for n in data.assumed) == (
        empty is not None
    )


LOST = {
    "its last pose": (lambda k: CIRCLE[99], range(100, 200)),
    "zero": (lambda k: np.zeros(3), range(100, 200)),
    "zero to the end": (lambda k: np.zeros(3), range(100, 301)),
    "another frame": (lambda k: compose(np.array([9.0, 0, 0]), CIRCLE[k]), []),
    "one line": (lambda k: CIRCLE[150] + [5, 0, 0], range(150, 151)),
}


@pytest.mark.parametrize("name", LOST)
def test_what_a_tracker_repeats_while_it_has_lost_the_robot_is_no_truth(tmp_path, name):
    """It jumps at the end; neither over the jumps nor at the lines has a row a true pose."""
    written, lost = LOST[name]
    truth = CIRCLE.copy()
    for k in lost or range(100, 200):
        truth[k] = written(k)
    on_a_circle(tmp_path, truth)
    data = datasets.table(tmp_path)
    known = ~np.isin(data.time, DRIVE[list(lost)])
    known[data.time == 14.95] = not {149, 150} & {*lost}
    np.testing.assert_array_equal(data.true_at, known)
    (note,) = [note for note in data.assumed if "is no motion" in note]
    assert ("repeat a pose" in note) == bool(lost)
    if lost:
        assert f"; {len(lost)} lines beside jumps" in note
    exact = np.stack([np.sin(0.3 * data.time), 1 - np.cos(0.3 * data.time)], axis=1)
    if lost:
        np.testing.assert_allclose(data.true_path[known, :2], exact[known], atol=0.02)


def test_a_true_path_with_a_hole_is_no_world_and_no_control(tmp_path):
    """`recorded_world` and `Mapping` would take a pose that is held over the hole for the truth."""
    text = on_a_circle(tmp_path).joinpath("truth.csv").read_text().splitlines(keepends=True)
    (tmp_path / "truth.csv").write_text("".join(text[:101] + text[250:]))
    data = datasets.table(tmp_path)
    places = np.zeros((data.capacity, 2))
    with pytest.raises(ValueError, match=r"^recorded_world: poses: expected .* of run 0, row 100: cut the log"):  # fmt: skip
        jaxslam.recorded_world(data.motion, data.sensor, [data.log], [data.true_path], places)
    mapping = jaxslam.filters.Mapping(data.sensor, data.capacity)
    log = data.log._replace(control=data.true_path)
    with pytest.raises(ValueError, match="control"):
        jaxslam.run(mapping, log, data.pose, data.pose_cov, jax.random.key(0))


def test_errors_are_those_of_the_rows_with_a_truth(tmp_path):
    """A path 0.2 m beside the truth everywhere: no error is of the hole, nor of a pair across it."""
    text = on_a_circle(tmp_path).joinpath("truth.csv").read_text().splitlines(keepends=True)
    (tmp_path / "truth.csv").write_text("".join(text[:101] + text[250:]))
    data = datasets.table(tmp_path)
    true = np.stack([np.sin(0.3 * data.time), 1 - np.cos(0.3 * data.time), 0.3 * data.time], axis=1)
    late = np.array([0.0, 0.3, 0.0]) * (data.time > 20)[:, None]  # drifts within the hole
    cov = np.tile(0.01 * np.eye(3), (data.steps, 1, 1))
    path = Estimate(true + [0.2, 0, 0] + late, cov, (), (), (), ())
    last = Estimate(*(leaf[-1] for leaf in (path.pose, cov)), np.zeros((1, 2)), cov[:1, :2, :2], np.zeros(1, bool), -np.ones(1, int))  # fmt: skip
    errors = evaluate(data, path, last).errors
    known = np.flatnonzero(data.true_at)
    square = np.where(data.time[known] > 20, 0.2**2 + 0.3**2, 0.2**2)
    np.testing.assert_allclose(errors["ATE [m]"], np.sqrt(square.mean()), rtol=1e-4)
    np.testing.assert_allclose(errors["pose NEES, mean (3 is honest)"], 100 * square.mean(), rtol=1e-3)  # fmt: skip
    assert errors["RPE over 1 s [m]"] < 1e-3


def test_measurements_in_a_gap_of_poses_are_left_out_and_counted(tmp_path):
    """Of a path of poses, between which a measurement would take an interpolated one."""
    text = on_a_circle(tmp_path).joinpath("truth.csv").read_text().splitlines(keepends=True)
    (tmp_path / "odometry.csv").write_text("".join(text[:101] + text[250:]))
    data = datasets.table(tmp_path)
    assert data.dropped["measurements in a gap of the odometry"] == 1
    assert data.measurements == 2 and 14.95 not in data.time
    assert any("no pose is interpolated over it" in note for note in data.assumed)
    # The increment over the gap is that of its two poses.
    whole = datasets.table(on_a_circle(tmp_path / "whole", odometry="".join(text)))
    at, pose = {}, np.zeros(3)
    for name, one in (("gap", data), ("whole", whole)):
        for t, u in zip(one.time, one.log.control, strict=True):
            pose = np.where(t == 0, 0.0, compose(pose, u[:3]))
            at[name, round(t, 6)] = pose
    np.testing.assert_allclose(at["gap", 30.0], at["whole", 30.0], atol=1e-6)


UNITS = {
    "bearing": ({"measurements": "t [s],tag,range [m],bearing [rad]\n0.5,7,2,14\n25,7,3,-170\n"}, "numbers are beyond 2π, up to -170: degrees? then write [deg] in the header"),
    "omega": ({"odometry": "t [s],v [m/s],omega [rad/s]\n0,0.3,17.2\n30,0.3,17.2\n"}, "2 of 2 numbers are beyond 2π, up to 17.2: degrees? then write [deg/s]"),
    "mount": ({"settings": "[sensor]\nmount = [0, 0, 180]"}, "[sensor] mount: theta [rad] = 180 is beyond 2π: degrees?"),
    "start": ({"settings": "[filter]\nstart = [0, 0, -90.0]"}, "[filter] start: theta [rad] = -90 is beyond 2π: degrees?"),
    "truth": ({"truth": CIRCLE * [1, 1, 180 / np.pi]}, "truth.csv: theta [rad] contradicts the directions between the positions"),
    "backwards": ({"truth": np.stack([*CIRCLE.T[:2], (np.rad2deg(CIRCLE[:, 2]) + 360) % 360 - 180], axis=1)}, "truth.csv: theta [rad] contradicts"),
}  # fmt: skip


@pytest.mark.parametrize("name", UNITS)
def test_degrees_under_rad_are_noted(tmp_path, name):
    files, note = UNITS[name]
    settings = files.pop("settings", "") if name in ("mount", "start") else ""
    on_a_circle(tmp_path, **files)
    (tmp_path / "dataset.toml").write_text(settings)
    (said,) = (line for line in datasets.table(tmp_path).assumed if note in line)
    assert "\n" not in said


@pytest.mark.parametrize(
    "path",
    [
        CIRCLE * [1, 1, 4],  # turns four times as fast as its way
        np.stack([DRIVE, 0 * DRIVE, 5 * DRIVE], axis=1),  # spins on its way along x
        CIRCLE + [0, 0, np.pi / 2],  # drives sideways
        CIRCLE * [0, 0, 1],
        np.stack([*CIRCLE.T[:2], 5 * np.sin(DRIVE)], axis=1),
    ],
)
def test_radians_and_other_robots_are_not_noted(tmp_path, path):
    data = datasets.table(on_a_circle(tmp_path, path))
    assert not any("contradicts" in note or "beyond" in note for note in data.assumed)


def test_stamps_and_deviations_in_other_units_are_noted(tmp_path):
    """Nanoseconds since 1970 under [s], and two degrees under [rad]."""
    on_a_circle(tmp_path)
    (tmp_path / "dataset.toml").write_text(
        '[sensor]\nmodel = "range_bearing"\nnoise = [0.1, 2.0]\n'
    )
    notes = [note for note in datasets.table(tmp_path).assumed if "degrees?" in note]
    assert notes == ["[sensor] noise: bearing [rad] = 2 is a standard deviation of 115°: degrees? write radians"]  # fmt: skip
    for name in ("odometry", "measurements", "truth"):
        text = (tmp_path / f"{name}.csv").read_text().splitlines()
        moved = [f"{1.7e18 + 1e9 * float(t):.0f},{rest}" for t, rest in (line.split(",", 1) for line in text[1:])]  # fmt: skip
        (tmp_path / f"{name}.csv").write_text("\n".join([text[0], *moved]))
    assert sum("nanoseconds?" in note for note in datasets.table(tmp_path).assumed) == 2


def test_tags_are_names_and_whole_numbers_as_pandas_writes_them(tmp_path):
    """As in `Log.from_records`: 11.0 is 11, text is a name, an empty cell, NaN and -1 are none."""
    seen = "t [s],tag,range [m],bearing [rad]\n0.5,11.0,2,0\n0.5,post_3,2,0\n0.5,,2,0\n1,NaN,2,0\n"
    seen += "1,<NA>,2,0\n1,-1,2,0\n1,11,2,0\n1,Post 3,2,0\n2,post_3,2,0\n2,1.2e1,2,0\n"
    data = datasets.table(on_a_circle(tmp_path, measurements=seen))
    assert data.tags == (11, 12, "Post 3", "post_3")
    scan = data.log.scan
    tags = [tag[valid].tolist() for tag, valid in zip(scan.tag, scan.valid, strict=True)]
    assert [tag for tag in tags if tag] == [[0, 3, -1], [-1, -1, -1, 0, 2], [3, 1]]
    survey = "tag,x [m],y [m]\npost_3,1,2\n11.0,3,4\nPost 3,5,6\n12,7,8\n"
    data = datasets.table(on_a_circle(tmp_path, measurements=seen, landmarks=survey))
    np.testing.assert_array_equal(data.landmarks, [[3, 4], [7, 8], [5, 6], [1, 2]])


@pytest.mark.parametrize(("unit", "factor"), [("ns", 10**9), ("us", 10**6), ("µs", 10**6), ("ms", 1000)])  # fmt: skip
def test_stamps_of_nineteen_digits_are_rounded_once(tmp_path, unit, factor):
    """As a quotient of whole numbers; float64 has 16 digits of 1,700,000,000,123,456,789 ns."""
    stamps = [1_700_000_000_123_456_789 * factor // 10**9 + k * (factor // 5) for k in range(3)]
    odometry = f"t [{unit}],v [m/s],omega [rad/s]\n" + "".join(f"{n},1,0\n" for n in stamps)
    seen = f"t [s],tag,range [m],bearing [rad]\n{stamps[1] / factor!r},7,2,0\n"
    folder = write(tmp_path, {"odometry.csv": odometry, "measurements.csv": seen})
    data = datasets.table(folder)
    np.testing.assert_array_equal(data.time, [n / factor for n in stamps])
    np.testing.assert_array_equal(data.log.scan.valid[:, 0], [False, True, False])


EXCEL = {
    "semicolons and decimal commas": (";", ",", "", ""),
    "quoted, a mark and sep=": (";", ",", "\ufeffsep=;\r\n", '"'),
    "semicolons and points": (";", ".", "", ""),
    "tabs and points": ("\t", ".", "", ""),
    "tabs and decimal commas": ("\t", ",", "sep=\t\n", ""),
    "commas and quoted decimal commas": (",", ",", "", '"'),
}


@pytest.mark.parametrize("name", EXCEL)
def test_what_excel_writes_is_read_where_it_is_certain(tmp_path, name):
    separator, decimal, head, quote = EXCEL[name]
    plain = datasets.table(on_a_circle(tmp_path / "plain"))
    for path in on_a_circle(tmp_path / "excel").iterdir():
        lines = path.read_text().splitlines()
        rows = [[cell.replace(".", decimal) for cell in line.split(",")] for line in lines]
        text = "\r\n".join(separator.join(f"{quote}{c}{quote}" for c in row) for row in rows)
        path.write_bytes((head + text + "\r\n").encode())
    data = datasets.table(tmp_path / "excel")
    chex.assert_trees_all_equal(data.log, plain.log)
    chex.assert_trees_all_equal(data.true_path, plain.true_path)
    signs = {";": "semicolons", "\t": "tabs", ",": "commas"}[separator]
    commas = ", decimal commas" * (decimal == ",")
    assert f"odometry.csv: cells separated by {signs}{commas}" in data.assumed


def test_a_landmark_that_is_only_measured_outside_the_odometry_is_left_out(tmp_path):
    """And counted, with a survey that lacks it, too."""
    seen = "t [s],tag,range [m],bearing [rad]\n0.5,7,2,0\n99,8,2,0\n"
    for survey in ({}, {"landmarks": "tag,x [m],y [m]\n7,1,2\n"}):
        data = datasets.table(on_a_circle(tmp_path, measurements=seen, **survey))
        assert (data.tags, data.measurements) == ((7,), 1)
        assert data.dropped == {"measurements outside the odometry": 1}


def test_the_prior_of_what_is_not_measured_is_a_default(tmp_path):
    """And with a survey localization is named, which needs none."""
    seen = "t [s],tag,range [m]\n0.5,7,2\n25,7,3\n"
    data = datasets.table(on_a_circle(tmp_path, measurements=seen))
    (line,) = (note for note in data.assumed if "free" in note)
    assert line.startswith("[sensor] free = [[0.0], [[3.28987]]] (prior mean and variance of the")
    assert "docs/methods/bearings_and_ranges.md" in line
    given = tmp_path / "dataset.toml"
    given.write_text("[sensor]\nfree = [[1.5], [[0.25]]]")
    data = datasets.table(
        on_a_circle(tmp_path, measurements=seen, landmarks="tag,x [m],y [m]\n7,1,2\n")
    )
    np.testing.assert_array_equal(data.sensor.free.mean, [1.5])
    (line,) = (note for note in data.assumed if "free" in note)
    assert "range [m] alone" in line and "--filters localization" in line


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
