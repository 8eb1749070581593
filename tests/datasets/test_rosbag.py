"""ROS bags: what is read of each message, dropped and counted, refused; the same log in every format."""

import tempfile

import bags
import broken
import numpy as np
import pytest
from bags import SECOND, fixed, odometry, quaternion, scan, transform
from cases import refused, swept
from command import run_command
from recordings import folder
from scipy.linalg import expm, logm

from jaxslam import datasets, laser_slam
from jaxslam.math import numpy_poses as poses

START = 1_700_000_000 * SECOND
RANGES = [1.5, np.nan, np.inf, 0.02, 30.0, -np.inf, 2.5]
TIMES = [START + k * SECOND // 4 for k in range(8)]
PATH = [(0.1 * k, 0.02 * k**2, 0.3 * k - 1) for k in range(5)]
DRIVE = [
    fixed("base_link", "laser", (0.2, -0.1, 0.3), quaternion(0.5))._replace(recorded=TIMES[0]),
    *(scan(t, np.add(RANGES, 0.01 * k)) for k, t in enumerate(TIMES)),
    *(odometry(TIMES[0] + k * SECOND // 2, pose) for k, pose in enumerate(PATH)),
]
UPSIDE_DOWN = (1.0, 0.0, 0.0, 0.0)
SCANS = [each for each in DRIVE if each.topic == "/scan"]
ODOMETRY = [each for each in DRIVE if each.topic == "/odom"]


def read(folder, messages, form="db3", *, empty=(), **options):
    into = tempfile.mkdtemp(dir=folder)
    return datasets.rosbag(bags.write(into, messages, form, empty=empty), **options)


def matrix(pose):
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([[c, -s, pose[0]], [s, c, pose[1]], [0, 0, 1]])


@pytest.mark.parametrize("form", bags.FORMATS)
def test_every_message_is_read(tmp_path, form):
    log = read(tmp_path, DRIVE, form)
    assert (log.name, log.laser, log.placed) == ("drive", "/scan", False)
    assert (log.dropped, log.corrections) == ({"beams without a range": 3 * 8}, ())
    np.testing.assert_allclose(log.time, np.array(TIMES) / SECOND, rtol=0, atol=3e-7)
    assert log.max_range == 30.0
    np.testing.assert_allclose(log.mount, [0.2, -0.1, 0.5], atol=1e-12)
    for k in range(8):
        expected = np.array([1.5 + 0.01 * k, 0, 30, 0, 30, 0, 2.5 + 0.01 * k])
        np.testing.assert_array_equal(log.beams.range[k], expected.astype(np.float32))
        np.testing.assert_array_equal(log.beams.valid[k], expected > 0)
        np.testing.assert_allclose(log.beams.angle[k], -1.5 + 0.5 * np.arange(7))
    np.testing.assert_array_equal(log.row, [0, 0, 1, 1, 2, 2, 3, 3])
    np.testing.assert_array_equal(log.odometry_known, np.ones(8, bool))
    np.testing.assert_allclose(log.odometry, PATH, atol=1e-12)
    np.testing.assert_allclose(log.odometry_time, log.time[0] + 0.5 * np.arange(5))
    for k in range(8):
        first, second = (matrix(PATH[i]) for i in (k // 2, k // 2 + 1))
        step = expm(0.5 * (k % 2) * np.real(logm(np.linalg.solve(first, second))))
        np.testing.assert_allclose(matrix(log.raw[k]), first @ step, atol=1e-9)
    np.testing.assert_array_equal(log.corrected, np.zeros((8, 3)))


def test_a_file_of_ros2_without_its_folder(tmp_path):
    for form in ("db3", "mcap"):
        made = bags.write(tmp_path, DRIVE, form, name=form)
        (file,) = made.glob(f"*.{form}")
        alone, whole = datasets.rosbag(file), datasets.rosbag(made)
        np.testing.assert_array_equal(alone.raw, whole.raw)
        np.testing.assert_array_equal(alone.beams.range, whole.beams.range)
        assert alone.corrections == whole.corrections


def test_a_part_of_a_step():
    step = np.array([[0.3, -0.2, 3.1], [1.0, 2.0, -1e-9], [0.4, 0.1, 0.0], [0.4, 0.1, np.pi]])
    third = poses.part(step, np.full(4, 1 / 3))
    whole = poses.compose(third, poses.compose(third, third))
    np.testing.assert_allclose(whole[:, :2], step[:, :2], atol=1e-12)
    np.testing.assert_allclose(poses.wrapped(whole[:, 2] - step[:, 2]), 0, atol=1e-12)
    np.testing.assert_array_equal(poses.part(step, np.ones(4))[:, 2], step[:, 2])
    np.testing.assert_allclose(poses.part(step, np.ones(4)), step, atol=1e-15)
    np.testing.assert_array_equal(poses.part(step, np.zeros(4)), np.zeros((4, 3)))


def seen(log):
    """The points of the first scan in the frame of the robot."""
    valid = np.asarray(log.beams.valid[0]) & (np.asarray(log.beams.range[0]) < log.max_range)
    r, a = (np.asarray(part[0])[valid] for part in (log.beams.range, log.beams.angle))
    points = np.stack([r * np.cos(a), r * np.sin(a), 0 * a], axis=1)
    return poses.compose(log.mount, points)[:, :2]


def rotation(q):
    x, y, z, w = q
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * k + 2 * k @ k


@pytest.mark.parametrize("increment", [0.5, -0.5])
@pytest.mark.parametrize("turned", [quaternion(0.4), UPSIDE_DOWN, (0.0, 1.0, 0.0, 0.0)])
def test_a_laser_in_any_pose_sees_the_points_that_the_chain_of_transforms_gives(
    tmp_path, turned, increment
):
    ranges = np.array([1.0, 2.0, 3.0, 4.0])
    chain = [
        fixed("base_link", "mast", (0.3, 0.1, 0.4), quaternion(-0.7)),
        transform(TIMES[0], "mast", "/laser", (0.05, 0.0, 0.2), turned),
        fixed("base_footprint", "base_link", (0.0, 0.0, 0.1), quaternion(0)),
    ]
    chain = [each._replace(recorded=TIMES[0]) for each in chain]
    log = read(tmp_path, [*chain, scan(TIMES[0], ranges, angle_increment=increment)])
    angle = -1.5 + increment * np.arange(4)
    points = ranges[:, None] * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    points = points @ rotation(turned).T + [0.05, 0, 0.2]
    points = points @ rotation(quaternion(-0.7)).T + [0.3, 0.1, 0.4]
    reversed_ = (increment < 0) != (turned[3] == 0)
    np.testing.assert_allclose(seen(log), points[:: -1 if reversed_ else 1, :2], atol=1e-6)
    assert (np.diff(log.beams.angle[0]) > 0).all()
    said = any(text.startswith("the laser is upside down") for text in log.corrections)
    assert said == (turned[3] == 0)


def test_a_given_mount_takes_the_place_of_that_of_the_bag(tmp_path):
    bag = bags.write(tmp_path, DRIVE)
    np.testing.assert_array_equal(datasets.rosbag(bag, mount=(1, 2, 3)).mount, [1, 2, 3])
    down = fixed("base_link", "laser", (0, 0, 0), UPSIDE_DOWN)._replace(recorded=TIMES[0])
    bag = bags.write(tmp_path, [down, *SCANS], name="down")
    log = datasets.rosbag(bag, mount=(1, 2, 3))
    np.testing.assert_array_equal(log.mount, [1, 2, 3])
    np.testing.assert_allclose(log.beams.angle[0], -1.5 + 0.5 * np.arange(7))
    np.testing.assert_allclose(log.beams.range[0, [0, 6]], [2.5, 1.5])
    assert log.corrections[0] == "the laser is upside down: the order of its beams is reversed"


def test_odometry_of_transforms(tmp_path):
    moved = [
        transform(m.recorded, "odom", "base_footprint", (*pose[:2], 0), quaternion(pose[2]))
        for m, pose in zip(ODOMETRY, PATH, strict=True)
    ]
    wheel = [transform(t, "base_link", "wheel", (0, 0, 0), quaternion(t % 7)) for t in TIMES]
    below = fixed("base_footprint", "base_link", (0, 0, 0.1), quaternion(0))
    bag = bags.write(
        tmp_path, [*DRIVE[:1], below._replace(recorded=TIMES[0]), *SCANS, *moved, *wheel]
    )
    log = datasets.rosbag(bag)
    plain = datasets.rosbag(bags.write(tmp_path, DRIVE, name="plain"))
    np.testing.assert_allclose(log.raw, plain.raw, atol=1e-12)
    np.testing.assert_allclose(log.mount, plain.mount, atol=1e-12)
    assert (log.dropped, log.corrections) == (plain.dropped, ())
    named = datasets.rosbag(bag, odometry="odom:base_footprint")
    np.testing.assert_array_equal(named.raw, log.raw)


def test_a_bag_without_odometry(tmp_path):
    log = read(tmp_path, SCANS)
    np.testing.assert_array_equal(log.raw, np.zeros((8, 3)))
    np.testing.assert_array_equal(log.odometry_known, np.arange(8) == 0)
    np.testing.assert_array_equal(log.row, np.full(8, -1))
    assert log.odometry.shape == (0, 3)
    assert log.corrections == (
        "no transform from base_link or base_footprint to the laser's frame 'laser': the laser is "
        "taken to be at the robot's centre, looking ahead",
        "the bag has no odometry: raw odometry stands still, and laser odometry takes its place",
    )


def test_scans_outside_of_the_odometry_take_its_ends(tmp_path):
    log = read(tmp_path, [DRIVE[0], *SCANS, *ODOMETRY[1:3]])
    np.testing.assert_array_equal(log.row, [-1, -1, 0, 0, 1, 1, 1, 1])
    np.testing.assert_array_equal(log.odometry_known, [1, 0, 0, 1, 1, 0, 0, 0])
    np.testing.assert_allclose(log.raw[[0, 1, 2]], [PATH[1]] * 3, atol=1e-12)
    np.testing.assert_allclose(log.raw[4:], [PATH[2]] * 4, atol=1e-12)
    assert log.corrections == (
        "scans before the first or after the last message of /odom, which take its pose: 5",
    )
    one = [odometry(TIMES[2], PATH[1])]
    log = datasets.rosbag(bags.write(tmp_path, [DRIVE[0], *SCANS, *one], name="one"))
    np.testing.assert_allclose(log.raw, [PATH[1]] * 8, atol=1e-12)


def test_a_gap_in_the_odometry_is_told(tmp_path):
    log = read(tmp_path, [DRIVE[0], *SCANS, ODOMETRY[0], ODOMETRY[4]])
    assert log.corrections == (
        "scans between two messages of /odom that are more than 1 s apart, with a constant "
        "velocity in between: 7",
    )
    np.testing.assert_array_equal(log.odometry_known, np.ones(8, bool))


def test_stamps_that_go_back_or_repeat_are_dropped_and_counted(tmp_path):
    stamps = [START + k * SECOND // 10 for k in range(30)]
    stamps[10] += 3600 * SECOND  # one is far ahead
    stamps[20] -= SECOND
    stamps[26] = stamps[25]
    scans = [
        scan(stamp, [1.0 + k], recorded=START + k * SECOND // 10) for k, stamp in enumerate(stamps)
    ]
    log = read(tmp_path, scans)
    kept = [k for k in range(30) if k not in (10, 20, 26)]
    np.testing.assert_array_equal(log.beams.range[:, 0], 1.0 + np.array(kept))
    assert (np.diff(log.time) > 0).all()
    assert log.dropped == {
        "scans whose stamp goes back": 2,
        "scans with the stamp of the one before": 1,
    }
    assert log.corrections[1] == (
        "stamps of /scan differ from the times of the recording by more than 1 s in 1 of 30 "
        "messages, by up to 3600 s"
    )


def test_stamps_of_zero_are_those_of_the_recording(tmp_path):
    log = read(tmp_path, [each._replace(make=scan(0, [1.0]).make) for each in SCANS])
    np.testing.assert_allclose(log.time, np.array(TIMES) / SECOND, rtol=0, atol=3e-7)
    assert "all stamps of /scan are 0: times are those of the recording" in log.corrections


def test_odometry_that_is_no_pose_is_dropped_and_counted(tmp_path):
    bad = [
        odometry(TIMES[1], (np.nan, 0, 0)),
        odometry(TIMES[3], (9, 9, 0), turned=(0, 0, 0, 0)),
        odometry(TIMES[5], (9, 9, 0), turned=(0, 0, np.inf, 1)),
    ]
    log = read(tmp_path, [*DRIVE, *bad])
    assert log.dropped["odometry without a pose"] == 3
    np.testing.assert_allclose(log.odometry, PATH, atol=1e-12)


def test_other_topics_are_counted_and_one_of_several_lasers_is_read(tmp_path):
    rear = [scan(t, [3.0, 4.0], "/rear") for t in TIMES[:5]]
    other = [odometry(t, (1, 1, 1), "/filtered") for t in TIMES]
    bag = bags.write(tmp_path, [*DRIVE, *rear, *other])
    log = datasets.rosbag(bag, "rear", "/odom")
    assert (log.laser, log.beams.range.shape) == ("/rear", (5, 2))
    assert log.dropped == {"messages /filtered": 8, "messages /scan": 8}
    np.testing.assert_array_equal(datasets.rosbag(bag, "/scan", "/filtered").raw, np.ones((8, 3)))


def test_the_first_echo_of_each_beam_is_its_range(tmp_path):
    many = [bags.echoes(t, [[1.5, 2.0], [], [np.inf], [3.0 + k]]) for k, t in enumerate(TIMES)]
    for form in ("bag", "mcap"):
        log = read(tmp_path, [DRIVE[0], *ODOMETRY, *many], form)
        assert log.laser == "/echoes"
        np.testing.assert_array_equal(log.beams.range[2], [1.5, 0, 30, 5])
        np.testing.assert_array_equal(log.beams.valid[2], [1, 0, 1, 1])
    # A LaserScan goes first; the other is read by its name.
    both = bags.write(tmp_path, [*DRIVE, *many], name="both")
    log = datasets.rosbag(both)
    assert (log.laser, log.dropped["messages /echoes"]) == ("/scan", 8)
    assert datasets.rosbag(both, "/echoes").beams.range.shape == (8, 4)
    two = [*many, *(each._replace(topic="/low") for each in many)]
    with pytest.raises(
        ValueError, match=r"one topic of sensor_msgs/MultiEchoLaserScan, got /echoes"
    ):
        read(tmp_path, two)


def split(messages, parts):
    """The messages of each part of a recording, by its time."""
    ends = np.quantile([each.recorded for each in messages], np.arange(1, parts) / parts)
    part = [np.searchsorted(ends, each.recorded) for each in messages]
    return [[m for m, k in zip(messages, part, strict=True) if k == n] for n in range(parts)]


@pytest.mark.parametrize("form", ["bag", "mcap", "db3"])
@pytest.mark.parametrize("name", ["drive_{}", "run_2024-05-01-12-0{0}-00_{0}"])
def test_parts_of_a_recording_are_one_log(tmp_path, form, name):
    whole = datasets.rosbag(bags.write(tmp_path, DRIVE, form, name="whole"))
    folder = tmp_path / "split"
    folder.mkdir()
    for k, messages in enumerate(split(DRIVE, 3)):
        path = bags.write(tmp_path, messages, form, name=name.format(k))
        file = path if form == "bag" else next(path.glob(f"*.{form}"))
        file.rename(folder / f"{name.format(k)}.{form}")
    log = datasets.rosbag(folder)
    for field in ("time", "raw", "odometry", "mount", "row", "odometry_known"):
        np.testing.assert_array_equal(getattr(log, field), getattr(whole, field))
    np.testing.assert_array_equal(log.beams.range, whole.beams.range)
    files = [f"{name.format(k)}.{form}" for k in range(3)]
    assert log.corrections == (f"one recording of 3 files, {', '.join(files)}",)
    assert datasets.rosbag_contents(folder).notes == log.corrections
    alone = datasets.rosbag(folder / files[2])
    assert alone.corrections[0] == (
        f"{files[2]} is read alone; beside it may be other parts of the recording, which the folder "
        f"reads as one: {files[0]}, {files[1]}"
    )
    (folder / files[1]).unlink()
    assert "parts that are missing in the folder: 1" in datasets.rosbag(folder).corrections


def test_bags_that_are_no_parts_of_one_recording_are_refused(tmp_path):
    later = [each._replace(recorded=each.recorded + 3600 * SECOND) for each in SCANS]
    for name, messages in (("run_1", SCANS), ("run_2", later)):
        bags.write(tmp_path, messages, name=name)
    with pytest.raises(
        ValueError, match=r"run_2.bag begins 3,598.2 s after run_1.bag ends; name one"
    ):
        datasets.rosbag(tmp_path)
    bags.write(tmp_path, SCANS, name="other")
    with pytest.raises(ValueError, match=r"NAME_1.bag, … of a recording, got other.bag, run_1.bag"):
        datasets.rosbag(tmp_path)


def rolled(roll, pitch, heading=0.0):
    """The quaternion (x, y, z, w) of the rotations by heading, pitch and roll."""
    (a, b, c), (d, e, f) = (
        np.cos([roll / 2, pitch / 2, heading / 2]),
        np.sin([roll / 2, pitch / 2, heading / 2]),
    )
    return (
        d * b * c - a * e * f,
        a * e * c + d * b * f,
        a * b * f - d * e * c,
        a * b * c + d * e * f,
    )


@pytest.mark.parametrize("upside_down", [False, True])
def test_roll_and_pitch_of_an_imu_leave_the_mount_in_the_plane(tmp_path, upside_down):
    tilts = 0.015 * np.random.default_rng(2).uniform(-1, 1, (8, 2))
    turned = UPSIDE_DOWN if upside_down else quaternion(0.4)
    imu = [
        transform(t, "base_footprint", "base_link", (0, 0, 0.1), rolled(*tilt))
        for t, tilt in zip(TIMES, tilts, strict=True)
    ]
    laser = fixed("base_link", "laser", (0.15, 0.1, 0.2), turned)._replace(recorded=TIMES[0])
    moved = [
        odometry(m.recorded, p, base="base_footprint") for m, p in zip(ODOMETRY, PATH, strict=True)
    ]
    log = read(tmp_path, [*SCANS, *moved, laser, *imu])
    np.testing.assert_allclose(log.mount[:2], [0.15, 0.1], atol=0.004)
    np.testing.assert_allclose(log.mount[2], 0 if upside_down else 0.4, atol=3e-4)
    assert log.corrections[0].startswith("the transform from base_footprint to base_link changes: ")
    assert ("the laser is upside down" in " ".join(log.corrections)) == upside_down
    # A laser that turns on the robot is none.
    turning = [each._replace(make=transform(each.recorded, "base_footprint", "base_link", (0, 0, 0.1), rolled(0, 0, 0.02 * k)).make) for k, each in enumerate(imu)]  # fmt: skip
    with pytest.raises(
        ValueError, match=r"from base_footprint to base_link changes by .* laser moves"
    ):
        read(tmp_path, [*SCANS, *moved, laser, *turning])
    # Nor one that nods by 20°.
    nods = [each._replace(make=transform(each.recorded, "base_footprint", "base_link", (0, 0, 0.1), rolled(0, 0.05 * k)).make) for k, each in enumerate(imu)]  # fmt: skip
    with pytest.raises(ValueError, match=r"is tilted by .* expected at most 10°"):
        read(tmp_path, [*SCANS, *moved, laser, *nods])


def test_the_last_static_transform_counts(tmp_path):
    again = fixed("base_link", "laser", (0.2, -0.05, 0.3), quaternion(0.6))
    log = read(tmp_path, [*DRIVE, again._replace(recorded=TIMES[1])])
    np.testing.assert_allclose(log.mount, [0.2, -0.05, 0.6], atol=1e-12)
    assert log.corrections == (
        "the static transform from base_link to laser was sent again, with a change of 0.05 m and "
        "5.73°: the last one is used",
    )
    same = DRIVE[0]._replace(recorded=TIMES[1])
    assert read(tmp_path, [*DRIVE, same]).corrections == ()
    elsewhere = [
        fixed(parent, child, (x, 0, 0), quaternion(0))._replace(recorded=TIMES[1])
        for parent, child, x in (("base_link", "plate", 0.0), ("plate", "laser", 0.3))
    ]
    log = read(tmp_path, [*DRIVE, *elsewhere])
    np.testing.assert_allclose(log.mount, [0.3, 0, 0], atol=1e-12)
    assert log.corrections == (
        "laser has static transforms from base_link and from plate: the last one is used",
    )


def named(parent, child):
    """The drive with odometry and mount in frames of these names, and a wheel that turns."""
    moved = [
        transform(m.recorded, parent, child, (*pose[:2], 0), quaternion(pose[2]))
        for m, pose in zip(ODOMETRY, PATH, strict=True)
    ]
    wheel = [
        transform(t, child, "wheel", (0, 0.2, 0), rolled(0, 0.3 * k)) for k, t in enumerate(TIMES)
    ]
    laser = fixed(child, "laser", (0.2, -0.1, 0.3), quaternion(0.5))._replace(recorded=TIMES[0])
    return [*SCANS, laser, *moved, *wheel]


@pytest.mark.parametrize(
    ("parent", "child"),
    [
        ("summit_odom", "summit_base_footprint"),
        ("odom_comb", "base_footprint"),
        ("odom", "chassis"),
    ],
)
def test_the_frames_that_move_are_the_odometry(tmp_path, parent, child):
    messages = named(parent, child)
    bag = bags.write(tmp_path, messages)
    log, plain = datasets.rosbag(bag), datasets.rosbag(bags.write(tmp_path, DRIVE, name="plain"))
    np.testing.assert_allclose(log.raw, plain.raw, atol=1e-12)
    np.testing.assert_allclose(log.mount, plain.mount, atol=1e-12)
    assert log.corrections == (
        f"odometry is the transform from {parent} to {child}, the only frames of /tf that move in "
        "the plane",
    )
    found = datasets.rosbag_contents(bag)
    assert found.odometry == {f"{parent}:{child}": 5}
    assert found.lasers["/scan"] == f"(0.2, -0.1, 28.65°) on {child}"
    assert found.frames == {
        f"{parent}:{child}": "5 transforms, moves",
        f"{child}:laser": "1 transforms, static",
        f"{child}:wheel": "8 transforms, turns",
    }
    # A map that moves, too: one of the two is chosen.
    above = [
        transform(t, "map", parent, (0.1 * k, 0, 0), quaternion(0)) for k, t in enumerate(TIMES)
    ]
    with pytest.raises(
        ValueError, match=rf"got map:{parent} \(8\), {parent}:{child} \(5\); choose"
    ):
        read(tmp_path, [*messages, *above])
    chosen = read(tmp_path, [*messages, *above], odometry=f"{parent}:{child}")
    np.testing.assert_allclose(chosen.raw, plain.raw, atol=1e-12)


def test_joints_are_no_odometry(tmp_path):
    """A wheel, a lift, and a laser that is not below what moves."""
    turns = [
        transform(t, "base_link", "wheel", (0, 0, 0), quaternion(0.1 * k))
        for k, t in enumerate(TIMES)
    ]
    lift = [
        transform(t, "base_link", "lift", (0.1 * k, 0, 0), quaternion(0))
        for k, t in enumerate(TIMES)
    ]
    log = read(tmp_path, [*SCANS, DRIVE[0], *turns, *lift])
    assert not log.odometry_known[1:].any()
    assert log.corrections == (
        "no odometry is read: raw odometry stands still, and laser odometry takes its place; frames "
        "of /tf that move: base_link:lift (8), base_link:wheel (8), of which --odometry "
        "base_link:lift reads one",
    )


def steadily(times):
    """Odometry of 6 cm and 3° in 0.2 s, 20 messages a second."""
    path = poses.chain(np.array([0.0, -1.2, 0.0]), np.tile([0.015, 0.0, 0.0125], (times - 1, 1)))
    stamps = [START + k * SECOND // 20 for k in range(times)]
    return stamps, path


@pytest.mark.parametrize("to", [(0.0, 0.0, 0.0), (2.0, -1.0, 1.0)])
def test_nothing_is_interpolated_over_a_jump_of_the_odometry(tmp_path, to):
    """A scan between two messages has the pose of the first, and the step over the jump is unknown."""
    stamps, path = steadily(200)
    path[100:] = poses.compose(np.array(to), poses.between(path[100], path[100:]))
    middle = stamps[1::4]
    scans = [scan(t + SECOND // 40, RANGES) for t in middle]
    log = read(tmp_path, [*scans, *map(odometry, stamps, path)])
    k = next(k for k, t in enumerate(middle) if t >= stamps[100])
    np.testing.assert_array_equal(np.flatnonzero(~log.odometry_known), [k])
    assert log.corrections[-1].startswith("jumps of /odom, which are no motion, so that the steps")
    assert ": 1, first by " in log.corrections[-1]
    at_jump = [scan(stamps[99] + SECOND // 40, RANGES)]
    log = read(tmp_path, [*scans, *at_jump, *map(odometry, stamps, path)])
    np.testing.assert_allclose(log.raw[k], path[99], atol=1e-12)
    np.testing.assert_array_equal(np.flatnonzero(~log.odometry_known), [k + 1])


def test_nothing_is_interpolated_over_a_long_gap_of_the_odometry(tmp_path):
    stamps, path = steadily(200)
    kept = [k for k in range(200) if not 50 <= k < 110]
    scans = [scan(t, RANGES) for t in stamps[::4]]
    log = read(tmp_path, [*scans, *(odometry(stamps[k], path[k]) for k in kept)])
    unknown = np.arange(52, 113, 4) // 4
    np.testing.assert_array_equal(np.flatnonzero(~log.odometry_known), unknown)
    np.testing.assert_allclose(log.raw[13:28], np.tile(path[49], (15, 1)), atol=1e-12)
    assert log.corrections[-1] == (
        "scans between two messages of /odom that are more than 1 s and 10 median intervals apart, "
        "with unknown steps: 15"
    )


def test_ranges_of_lasers_without_a_maximum(tmp_path):
    scans = [scan(TIMES[0], [1.0, 60.0], range_max=0.0), scan(TIMES[1], [1.0, 2.0, 3.0])]
    log = read(tmp_path, scans, max_range=20.0)
    np.testing.assert_array_equal(log.beams.range, [[1, 20, 0], [1, 2, 3]])
    np.testing.assert_array_equal(log.beams.valid, [[1, 1, 0], [1, 1, 1]])
    assert "scans without a maximum range above 0, which take max_range: 1" in log.corrections


def backward(topic):
    """A drive whose clock goes back by 20 s in the middle."""
    made, value = (scan, [1.0]) if topic == "/scan" else (odometry, (0, 0, 0))
    times = [START + k * SECOND - (20 * SECOND if k >= 25 else 0) for k in range(50)]
    return [
        *(each for each in DRIVE if each.topic != topic),
        *(made(t, value, recorded=START + k * SECOND) for k, t in enumerate(times)),
    ]


def tilted(angle):
    turned = (0.0, np.sin(angle / 2), 0.0, np.cos(angle / 2))
    return [fixed("base_link", "laser", (0, 0, 1), turned)._replace(recorded=TIMES[0]), *SCANS]


def moving():
    return [
        *SCANS,
        *(
            transform(t, "base_link", "laser", (0, 0, 0), quaternion(k))
            for k, t in enumerate(TIMES)
        ),
    ]


ROBOTS = [
    *SCANS,
    *(
        transform(t, f"{r}/odom", f"{r}/base_link", (0, 0, 0), quaternion(0))
        for r in "ab"
        for t in TIMES
    ),
]
NONE = [("/scan", "sensor_msgs/msg/LaserScan"), ("/odom", "nav_msgs/msg/Odometry")]


@refused(
    (ODOMETRY, NONE, {}, r"got /odom \(nav_msgs/Odometry, 5\), /scan \(sensor_msgs/LaserScan, 0\)"),
    (DRIVE, (), {"scan": "/odom"}, r"scan \(--laser\): expected a topic of sensor_msgs/LaserScan or sensor_msgs/MultiEchoLaserScan, got /odom of nav"),
    (DRIVE, (), {"odometry": "/scan"}, r"odometry \(--odometry\): expected a topic of nav_msgs/Odometry, got /scan"),
    (DRIVE, (), {"scan": "no"}, r"scan \(--laser\): expected a topic of /scan \(sensor.*, 8\); got 'no'"),
    (SCANS, NONE, {"odometry": "odom"}, r"odometry \(--odometry\): the topic /odom has no messages"),
    (
        [*DRIVE, scan(TIMES[0], [1.0], "/a")], (), {},
        r"expected one topic of sensor_msgs/LaserScan, got /a \(.*, 1\), /scan \(.*, 8\); choose by scan='/a' \(--laser /a\)",
    ),
    (
        [*DRIVE, odometry(TIMES[0], PATH[0], "/ekf")], (), {},
        r"expected one topic of nav_msgs/Odometry, got /ekf .* choose by odometry='/ekf' \(--odometry /ekf\)",
    ),
    (ROBOTS, (), {}, r"got a/odom:a/base_link \(8\), b/odom:b/base_link \(8\); choose by odometry='a/odom:a"),
    (ROBOTS, (), {"odometry": "odom:base"}, r"the transforms a/odom:a/base_link, b/odom:b/base_link; got 'odom:base'"),
    (SCANS, (), {"odometry": "odom:base"}, r"the transforms \(none\); got 'odom:base'"),
    ([scan(TIMES[0], [])], (), {}, "/scan: expected scans with beams, got 1 of 0 beams"),
    ([*SCANS, scan(TIMES[7] + 9, [1, 2], angle_increment=0.0)], (), {}, "/scan: scan 8: expected a finite angle_min"),
    ([scan(TIMES[0], [1, 2], angle_min=np.nan)], (), {}, "/scan: scan 0: expected a finite angle_min"),
    ([*SCANS, scan(TIMES[7] + 9, [1, 2], frame="b")], (), {}, "/scan: expected scans of one frame, got b, laser"),
    (tilted(0.3), (), {}, r"'laser' is tilted by 17.2° against base_link; expected at most 10°"),
    (moving(), (), {}, r"the transform from base_link to laser changes by 0 m and \d+.*°, so the laser moves"),
    (backward("/scan"), (), {}, "/scan: the stamps of 19 of 50 messages go back, first by 19 s at message 25; expected at most 10%"),
    (backward("/odom"), (), {}, "/odom: the stamps of 19 of 50 messages go back"),
    ([*SCANS, odometry(START - SECOND, PATH[0])], (), {}, r"expected scans within the time of /odom, from 1699999999.000 s"),
    ([*SCANS, odometry(START, PATH[0], turned=(0, 0, 0, 0))], (), {}, "/odom: none of 1 messages has a pose"),
    told="drive: .*",
)  # fmt: skip
def test_what_is_refused(messages, empty, options, tmp_path):
    read(tmp_path, messages, empty=empty, **options)


def test_a_laser_that_is_tilted_a_little_is_told(tmp_path):
    log = read(tmp_path, tilted(0.05))
    assert log.corrections[0] == "the laser is tilted by 2.86°: its ranges are taken for level ones"


@refused(
    ({"max_range": 0}, "rosbag: max_range: expected a number above 0, got 0"),
    (
        {"mount": (1, 2)},
        r"rosbag: mount: expected finite numbers of shape \(3,\), got a tuple of shape",
    ),
    ({}, "no.bag: cannot be read: no such file"),
)
def test_arguments_that_do_not_fit(options):
    datasets.rosbag("no.bag", **options)


@pytest.mark.parametrize("form", swept(bags.FORMATS, "bag", "mcap"))
def test_a_truncated_bag_is_refused(tmp_path, form):
    path = bags.write(tmp_path, DRIVE, form)
    file = path if form == "bag" else next(f for f in path.iterdir() if f.suffix != ".yaml")
    whole = file.read_bytes()
    for share in (0.0, 0.01, 0.3, 0.6, 0.9):
        file.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(ValueError, match=r"drive.*: cannot be read as a ROS bag") as caught:
            datasets.rosbag(path)
        assert "\n" not in str(caught.value)
    (tmp_path / "text.bag").write_text("ODOM 1 2 3\n")
    with pytest.raises(ValueError, match=r"text.bag: cannot be read as a ROS bag: File magic"):
        datasets.rosbag(tmp_path / "text.bag")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"cannot be read: no such metadata.yaml"):
        datasets.rosbag(tmp_path / "empty")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"float32 range_min", b"float32 range_low"),
        (b"string frame_id", b"string frame_no"),
        (b"MSG: geometry_msgs/Point", b"MSG: geometry_msgs/Poinx"),
    ],
)
def test_a_bag_that_defines_a_message_otherwise_is_refused(tmp_path, old, new):
    path = bags.write(tmp_path, DRIVE, "mcap")
    file = next(path.glob("*.mcap"))
    assert old in file.read_bytes()
    file.write_bytes(file.read_bytes().replace(old, new))
    lacking = r"(sensor_msgs/LaserScan/range_min|std_msgs/Header/frame_id|geometry_msgs/Point)$"
    with pytest.raises(ValueError, match=r"expected the messages of ROS, without " + lacking):
        datasets.rosbag(file)  # with its folder the hashes of types differ


def test_a_library_that_cannot_be_used_is_named(tmp_path, monkeypatch, capsys):
    sources = {"highlevel": "class AnyReader: pass", "typesys": "class Stores: pass"}
    broken.library(monkeypatch, tmp_path, "rosbags", sources)
    with pytest.raises(ValueError, match=r"rosbag: rosbags .* cannot be used .*get_typestore"):
        datasets.rosbag(tmp_path)
    broken.library(monkeypatch, tmp_path, "rosbags", {}, "0.10.1")
    with pytest.raises(ImportError, match=r"0.10.1 is too old, .* pip install 'jaxslam\[ros\]'$"):
        datasets.rosbag_contents(tmp_path)
    assert run_command(["slam", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_the_contents_of_a_bag(tmp_path):
    bag = bags.write(tmp_path, [*DRIVE, scan(TIMES[0], [1.0], "/b", frame="b")], empty=NONE)
    found = datasets.rosbag_contents(bag)
    assert [(each.name, each.count) for each in found.topics] == [
        *(("/b", 1), ("/odom", 5), ("/scan", 8), ("/tf_static", 1))
    ]
    assert found.lasers["/scan"] == "(0.2, -0.1, 28.65°) on base_link"
    assert found.lasers["/b"].startswith("no transform from base_link or base_footprint to the")
    assert (found.start, round(found.end - found.start, 6)) == (START / SECOND, 2.0)
    nothing = datasets.rosbag_contents(bags.write(tmp_path, [], name="nothing", empty=NONE))
    assert np.isnan(nothing.start) and nothing.lasers == {}


def test_recorded_bags():
    here = folder("bags")
    log = datasets.rosbag(here / "laser_scan_matcher.bag")
    assert log.beams.range.shape == (360, 681) and not log.odometry_known[1:].any()
    assert log.max_range == np.float32(5.6) and log.dropped == {"beams without a range": 13342}
    np.testing.assert_allclose(log.time[-1] - log.time[0], 35.816, atol=1e-3)
    with pytest.raises(ValueError, match=r"turtlebot3: expected a topic of sensor_msgs/LaserScan"):
        datasets.rosbag(here / "turtlebot3")
    with pytest.raises(ValueError, match=r"husky.bag: expected a topic of sensor_msgs/LaserScan"):
        datasets.rosbag(here / "husky.bag")
    assert datasets.rosbag_contents(here / "turtlebot3").odometry == {"odom:base_footprint": 72}


def csail(scans):
    """The first scans of MIT CSAIL from CARMEN, angles and ranges rounded to the 32 bits of a LaserScan."""
    data = folder("laser_graphs").parent
    log = datasets.carmen(
        data / "laser_graphs" / "mit-cscail.log",
        odometry=data / "relations" / "csail_raw_odometry.txt",
    )
    return bags.first(log, scans)


FIELDS = "time", "raw", "odometry_known", "row", "odometry", "odometry_time", "mount", "max_range"


@pytest.mark.parametrize("scans", swept([40, 1051], 40))
def test_csail_as_a_bag_is_the_log_of_carmen(tmp_path, scans):
    log = csail(scans)
    messages = bags.of_log(log)
    for form in ("bag", "db3", "mcap"):
        found = datasets.rosbag(bags.write(tmp_path, messages, form, name=form))
        assert len(found.time) == scans
        for name in FIELDS:
            np.testing.assert_allclose(getattr(found, name), getattr(log, name), rtol=0, atol=1e-12)
        for part, expected in zip(found.beams, log.beams, strict=True):
            np.testing.assert_array_equal(part, expected)


@pytest.mark.sweep
def test_csail_as_a_bag_has_the_path_of_carmen(tmp_path, full_optimization):
    log = csail(1051)
    expected = laser_slam.solve(log).poses
    found = laser_slam.solve(datasets.rosbag(bags.write(tmp_path, bags.of_log(log), "mcap")))
    np.testing.assert_allclose(found.poses, expected, rtol=0, atol=1e-9)
