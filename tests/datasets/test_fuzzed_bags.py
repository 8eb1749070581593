"""ROS bags with flipped bits, and of odd messages: a log, or a line of ValueError that names the bag."""

from functools import cache

import bags
import chex
import hypothesis.strategies as st
import numpy as np
import pytest
from bags import SECOND, fixed, odometry, quaternion, scan, transform
from fuzzing import FLIPS, assert_one_line, flipped, fuzz, watched
from hypothesis import given
from recordings import folder

from jaxslam import datasets

START = 1_700_000_000 * SECOND
TIMES = [START + k * SECOND // 4 for k in range(6)]
DRIVE = [
    fixed("base_link", "laser", (0.2, -0.1, 0.3), quaternion(0.5))._replace(recorded=TIMES[0]),
    *(scan(t, [1.0, 2.0, 0.5, np.inf]) for t in TIMES),
    *(odometry(t, (0.1 * k, 0.0, 0.02 * k)) for k, t in enumerate(TIMES)),
]
FILE = {"bag": "drive.bag", "db3": "drive.db3", "mcap": "drive.mcap", "zstd": "drive.db3"}


@cache
def written(form, where):
    """{name: bytes} of the files of the drive as a bag."""
    path = bags.write(where, DRIVE, form, name=f"{form}/drive" if form == "bag" else form)
    parts = [path] if form == "bag" else sorted(path.iterdir())
    return {part.name: part.read_bytes() for part in parts}


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """The files of the drive in a format."""
    where = tmp_path_factory.mktemp("bags")
    (where / "bag").mkdir()
    return lambda form: written(form, where)


def read(path):
    """The log and the contents of a bag."""
    log = datasets.rosbag(path)
    assert datasets.rosbag_contents(path).topics
    return log


def assert_log(log):
    """Finite numbers, and ranges above 0."""
    chex.assert_tree_all_finite((log.time, log.beams, log.raw, log.odometry, log.mount))
    assert (log.beams.range[log.beams.valid] > 0).all()


def assert_read(path, root):
    """A log, or a line that names the bag."""
    try:
        log = watched(lambda _: read(path), root)
    except ValueError as error:
        assert_one_line(error, root)
    else:
        assert_log(log)


@pytest.mark.parametrize("form", bags.FORMATS)
@fuzz(25)
@given(data=st.data())
def test_bags_with_flipped_bits(form, data, drive, tmp_path):
    files = drive(form)
    wrong = data.draw(st.sampled_from(sorted(files)))
    for name, content in files.items():
        damaged = flipped(content, data.draw(FLIPS)) if name == wrong else content
        (tmp_path / name).write_bytes(damaged)
    first = next(name for name in sorted(files) if not name.endswith(".yaml"))
    path = tmp_path if "metadata.yaml" in files and data.draw(st.booleans()) else tmp_path / first
    assert_read(path, tmp_path)


NUMBER = st.one_of(
    st.floats(-3, 3), st.sampled_from([0.0, np.nan, np.inf, -np.inf, 1e300, -1e300, 1e-320])
)
SHORT = st.one_of(st.floats(-3, 3, width=32), st.sampled_from([0.0, np.nan, np.inf, 2.0**60]))
STAMPS = st.one_of(
    st.sampled_from(TIMES), st.sampled_from([0, 1, START - 10**12, (2**31 - 1) * SECOND])
)
FRAMES = st.sampled_from(["laser", "base_link", "odom", "", "/laser", "map", "é\n"])
TURNS = st.one_of(
    NUMBER.map(lambda a: quaternion(a) if np.isfinite(a) else (0.0, 0.0, a, 1.0)),
    st.tuples(NUMBER, NUMBER, NUMBER, NUMBER),
)
SCANS = st.builds(
    lambda stamp, values, some: scan(stamp, values, **some),
    STAMPS,
    st.lists(SHORT, max_size=5),
    st.fixed_dictionaries(
        {},
        optional={
            "frame": FRAMES,
            "angle_min": SHORT,
            "angle_increment": SHORT,
            "range_min": SHORT,
            "range_max": SHORT,
            "recorded": st.sampled_from(TIMES),
            "topic": st.sampled_from(["/scan", "/a"]),
        },
    ),
)
ODOMETRY = st.builds(
    lambda stamp, pose, turned, base: odometry(stamp, pose, turned=turned, base=base),
    STAMPS,
    st.tuples(NUMBER, NUMBER, st.floats(-3, 3)),
    st.one_of(st.none(), TURNS),
    FRAMES,
)
TRANSFORMS = st.builds(
    transform,
    STAMPS,
    FRAMES,
    FRAMES,
    st.tuples(NUMBER, NUMBER, NUMBER),
    TURNS,
    st.sampled_from(["/tf", "/tf_static"]),
)
MESSAGES = st.lists(st.one_of(SCANS, ODOMETRY, TRANSFORMS), max_size=6)


@pytest.mark.parametrize("form", ["bag", "mcap"])
@fuzz(50)
@given(messages=MESSAGES, whole=st.booleans())
def test_bags_of_odd_messages(form, messages, whole, tmp_path_factory):
    root = tmp_path_factory.mktemp("odd")
    sound = [one for one in messages if one.recorded >= 0]
    assert_read(bags.write(root, [*(DRIVE if whole else []), *sound], form), root)


@pytest.mark.parametrize("name", ["laser_scan_matcher.bag", "turtlebot3"])
@fuzz(10)
@given(flips=FLIPS)
def test_recorded_bags_with_flipped_bits(name, flips, tmp_path):
    whole = folder("bags") / name
    for path in whole.iterdir() if whole.is_dir() else [whole]:
        content = path.read_bytes()
        named = path.suffix in (".bag", ".db3")
        (tmp_path / path.name).write_bytes(flipped(content, flips) if named else content)
    assert_read(tmp_path if whole.is_dir() else tmp_path / name, tmp_path)
