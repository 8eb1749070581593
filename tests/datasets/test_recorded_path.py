"""Recorded paths: topics and frames of bags, CSV files as `jaxslam run` writes them, TUM."""

import gzip

import bags
import jax
import numpy as np
import pytest
from bags import SECOND, fixed, odometry, quaternion, stamped_pose, transform
from cases import refused

import jaxslam
from jaxslam.consistency import judge_recording
from jaxslam.core.types import Estimate
from jaxslam.datasets import recorded_path
from jaxslam.math import numpy_poses as poses
from jaxslam.results import report

START = 1_700_000_000 * SECOND
TIMES = [START + k * SECOND // 10 for k in range(6)]
PATH = np.array([(0.1 * k, 0.02 * k**2, 0.6 * k - 1) for k in range(6)])
PATH[:, 2] = poses.wrapped(PATH[:, 2])
COVS = [
    np.array([[2.0, 0.3, 0.1], [0.3, 1.0, 0.2], [0.1, 0.2, 0.5]]) * (1 + 0.1 * k) for k in range(6)
]
KINDS = {
    "/amcl_pose": "PoseWithCovarianceStamped",
    "/mocap/pose": "PoseStamped",
    "/vicon/robot": "TransformStamped",
}


def drive():
    """A message of each type with a pose at each time."""
    messages = [odometry(t, p, cov=c) for t, p, c in zip(TIMES, PATH, COVS, strict=True)]
    for topic, kind in KINDS.items():
        messages += [
            stamped_pose(t, p, topic, c, kind=kind)
            for t, p, c in zip(TIMES, PATH, COVS, strict=True)
        ]
    return messages


@pytest.mark.parametrize("form", ["bag", "mcap"])
def test_every_type_of_topic(tmp_path, form):
    bag = bags.write(tmp_path, drive(), form)
    for topic in ("/odom", *KINDS):
        path = recorded_path(f"{bag}:{topic}")
        np.testing.assert_allclose(path.time, np.array(TIMES) / SECOND, rtol=0, atol=3e-7)
        np.testing.assert_allclose(path.pose, PATH, atol=1e-12)
        assert path.frame == ("odom" if topic == "/odom" else "map")
        assert (path.dropped, path.notes, path.source) == ({}, (), f"{bag}:{topic}")
        if topic in ("/odom", "/amcl_pose"):
            np.testing.assert_allclose(path.cov, COVS)
        else:
            assert path.cov is None
    np.testing.assert_array_equal(
        recorded_path(f"{bag}:amcl_pose").pose, recorded_path(f"{bag}:/amcl_pose").pose
    )


def test_messages_that_are_no_pose_or_out_of_order(tmp_path):
    messages = [stamped_pose(t, p, "/pose") for t, p in zip(TIMES, PATH, strict=True)]
    messages += [
        stamped_pose(TIMES[-1] + 1, PATH[0], "/pose", turned=(0, 0, 0, 0))._replace(
            recorded=TIMES[-1] + 1
        ),
        stamped_pose(TIMES[-1], PATH[0], "/pose")._replace(recorded=TIMES[-1] + 2),
    ]
    path = recorded_path(f"{bags.write(tmp_path, messages)}:/pose")
    np.testing.assert_allclose(path.pose, PATH, atol=1e-12)
    assert path.dropped == {
        "messages without a pose": 1,
        "messages with the stamp of the one before": 1,
    }


def test_two_frames_of_tf(tmp_path):
    """map -> odom rarely, odom -> base_link often, and a marker that is fixed on the robot."""
    corrections = [(START + k * SECOND // 2, (0.2 * k, 0.1, 0.3 * k)) for k in range(3)]
    marker = (0.2, -0.1, 0.5)
    messages = [
        *(transform(t, "map", "odom", (*p[:2], 0.0), quaternion(p[2])) for t, p in corrections),
        *(
            transform(t, "odom", "base_link", (*p[:2], 0.0), quaternion(p[2]))
            for t, p in zip(TIMES, PATH, strict=True)
        ),
        fixed("base_link", "marker", (*marker[:2], 0.0), quaternion(marker[2]))._replace(
            recorded=START
        ),
    ]
    bag = bags.write(tmp_path, messages)
    share = np.arange(6) / 5
    first = np.array(corrections[0][1])
    step = poses.between(first, np.array(corrections[1][1]))
    at = poses.compose(first, poses.part(np.tile(step, (6, 1)), share))
    expected = poses.compose(at, PATH)
    for source in ("map:base_link", "/tf:map:base_link"):
        path = recorded_path(f"{bag}:{source}")
        np.testing.assert_allclose(path.pose, expected, atol=1e-6)
        np.testing.assert_allclose(path.time, np.array(TIMES) / SECOND, rtol=0, atol=3e-7)
        assert (path.cov, path.frame) == (None, "map")
    np.testing.assert_allclose(
        recorded_path(f"{bag}:map:marker").pose,
        poses.compose(expected, np.array(marker)),
        atol=1e-6,
    )
    np.testing.assert_allclose(
        recorded_path(f"{bag}:base_link:odom").pose, poses.inverse(PATH), atol=1e-12
    )


def test_an_ekf_written_as_a_bag_has_the_scores_of_its_arrays(tmp_path):
    world = jaxslam.scenarios.circle(steps=300)
    filter = jaxslam.filters.Localization(world.motion, world.sensor, world.landmarks)
    truth, log = jaxslam.simulate(world, jax.random.key(0))
    run = jaxslam.run(filter, log, world.pose, world.pose_cov, jax.random.key(1)).estimate
    pose, cov, path = (np.asarray(part, float) for part in (run.pose, run.pose_cov, truth.pose))
    stamps = [START + k * SECOND for k in range(300)]
    messages = [
        stamped_pose(t, p, "/amcl_pose", c, kind="PoseWithCovarianceStamped")
        for t, p, c in zip(stamps, pose, cov, strict=True)
    ]
    messages += [stamped_pose(t, p, "/mocap") for t, p in zip(stamps, path, strict=True)]
    bag = bags.write(tmp_path, messages, "mcap")
    estimate, reference = recorded_path(f"{bag}:/amcl_pose"), recorded_path(f"{bag}:/mocap")
    read = judge_recording(
        (estimate.time, estimate.pose, estimate.cov), (reference.time, reference.pose)
    )
    time = np.array(stamps) / SECOND
    scores = judge_recording((time, pose, cov), (time, path))
    assert read.verdict == scores.verdict
    for name, block in scores.blocks.items():
        np.testing.assert_allclose(read.blocks[name].nees, block.nees, rtol=1e-6)
    assert scores.blocks["pose"].nees.low < 3 < scores.blocks["pose"].nees.high


def written(folder, zipped=False):
    """A trajectory.csv as `jaxslam run` writes it, and trajectory.tum."""
    none = np.zeros((6, 0))
    estimate = Estimate(PATH, np.array(COVS), none[..., None], none[..., None, None], none, none)
    time = np.array(TIMES) / SECOND
    text = report.trajectory_csv(time, estimate)
    file = folder / ("trajectory.csv.gz" if zipped else "trajectory.csv")
    file.write_bytes(gzip.compress(text.encode()) if zipped else text.encode())
    (folder / "trajectory.tum").write_text(report.trajectory_tum(time, estimate))
    return file


@pytest.mark.parametrize("zipped", [False, True])
def test_what_jaxslam_run_writes(tmp_path, zipped):
    path = recorded_path(written(tmp_path, zipped))
    np.testing.assert_array_equal(path.time, np.array(TIMES) / SECOND)
    np.testing.assert_allclose(path.pose, PATH, atol=1e-8)
    np.testing.assert_allclose(path.cov, COVS, rtol=1e-8)
    tum = recorded_path(tmp_path / "trajectory.tum")
    np.testing.assert_allclose(tum.pose, PATH, atol=1e-8)
    np.testing.assert_array_equal(tum.time, path.time)
    assert tum.cov is None


def test_a_csv_file_with_units(tmp_path):
    file = tmp_path / "truth.csv"
    lines = [
        f"{t},{100 * x},{100 * y},{np.rad2deg(h)}" for t, (x, y, h) in zip(TIMES, PATH, strict=True)
    ]
    file.write_text("\n".join(["t [ns],x [cm],y [cm],theta [deg]", *lines]))
    path = recorded_path(file)
    np.testing.assert_array_equal(path.time, np.array(TIMES) / SECOND)
    np.testing.assert_allclose(path.pose, PATH, atol=1e-12)
    assert path.cov is None


HEAD = "time,x,y,theta\n"


@refused(
    (
        "a.csv",
        HEAD + "1,0,0,0\n1,0,0,0\n",
        "a.csv:3: column 1 .time.: expected a time above 1.0, got 1.0",
    ),
    (
        "a.csv",
        HEAD + "1700000000000000000,0,0,0\n1700000000100000000,0,0,0\n",
        r"a.csv:2: column 1 .time.: expected a time in seconds, got 1.7e\+18: .* t \[ns\]",
    ),
    (
        "a.csv",
        HEAD + "1,0,0,north\n",
        "a.csv:2: column 4 .theta.: expected a finite number, got 'north'",
    ),
    ("a.csv", "time,x,y\n1,0,0\n", r"a.csv:1: expected a column 'theta \[rad\]' "),
    ("a.csv", "time,x,y,theta,c_xx\n1,0,0,0,1\n", "a.csv:1: expected all of c_xx, .* got no c_xy"),
    (
        "a.csv",
        "t,x,y,theta [deg],c_xx,c_xy,c_xt,c_yy,c_yt,c_tt\n1,0,0,0,1,0,0,1,0,1\n",
        r"a.csv:1: expected theta \[rad\]",
    ),
    (
        "a.csv",
        HEAD
        + "".join(
            f"{k},{5 * np.sin(k / 5)},{-5 * np.cos(k / 5)},{36 / np.pi * k}\n" for k in range(30)
        ),
        "a.csv:1: expected theta in radians, but it fits the positions in degrees: write theta .deg",
    ),
    ("a.tum", "# t x y\n1 0 0 0 0 0 0\n", "a.tum:2: expected 8 fields"),
    ("a.tum", "1 0 0 0 0 0 0 2\n", "a.tum:1: expected a quaternion of norm 1"),
    ("a.tum", "2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "a.tum:2: expected a time above 2.0, got 1.0"),
    ("a.tum", "# nothing\n", "a.tum:1: expected lines t x y"),
    ("a.txt:/pose", "", "a.txt: expected a ROS bag before '/pose'"),
    ("b.csv", None, "b.csv: cannot be read"),
    ("b.bag:/pose", None, "b.bag: cannot be read: no such file"),
)
def test_a_file_that_is_no_path_is_refused(name, text, tmp_path):
    if text is not None:
        (tmp_path / name.split(":")[0]).write_text(text)
    recorded_path(f"{tmp_path}/{name}")


@refused(
    (
        "",
        "expected BAG:/topic, of /amcl_pose .*, or two frames of /tf, as BAG:map:base_link; got ''",
    ),
    (":/none", "expected BAG:/topic, .* got '/none'"),
    (":/tf", "/tf: expected messages of nav_msgs/Odometry, .* got tf2_msgs/TFMessage"),
    (
        ":map:base",
        "expected two frames of the transforms map:odom, with a path between them; got map:base",
    ),
    (":/two", "/two: expected poses in one frame, got map, world"),
    (":/still", "/still: none of 1 messages has a pose in the plane"),
)
def test_a_topic_that_is_no_path_is_refused(inside, tmp_path):
    messages = [
        *drive(),
        transform(START, "map", "odom", (0, 0, 0), quaternion(0)),
        stamped_pose(START, PATH[0], "/two"),
        stamped_pose(START + 1, PATH[0], "/two", frame="world"),
        stamped_pose(START, PATH[0], "/still", turned=(0, 0, 0, 0)),
    ]
    recorded_path(f"{bags.write(tmp_path, messages)}{inside}")
