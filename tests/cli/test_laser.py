"""The commands on a laser log: a map that ROS reads, a row for every scan, bad input."""

import dataclasses
import json
from types import SimpleNamespace

import bags
import broken
import jax
import numpy as np
import pytest
import yaml
from PIL import Image
from reference.walls import is_free
from ring_of_rooms import FAR, ranges_of

from jaxslam import _cli as cli
from jaxslam import datasets, grids
from jaxslam.core.types import Estimate
from jaxslam.math import numpy_poses as poses
from jaxslam.results import report
from jaxslam.simulation.laser import scan_world
from jaxslam.simulation.scenarios import square
from jaxslam.simulation.walls import make_walls, rasterize

BEAMS, STEPS = 25, cli.make_map.SCANS_AT_ONCE + 6
FIT = "beams of the last 10 scans within 0.3 m of the map's range, share"


def line(ranges, pose, raw, t):
    """ODOM and FLASER lines of a scan; the beams of FLASER look ahead, 180° wide."""
    numbers = " ".join(f"{r:.4f}" for r in ranges)
    x, y, h = pose
    return (
        f"ODOM {raw[0]} {raw[1]} {raw[2]} 0 0 0 {t} robot {t}\n"
        f"FLASER {len(ranges)} {numbers} {x} {y} {h} {x} {y} {h} {t} robot {t}\n"
    )


@pytest.fixture(scope="module")
def log_file(tmp_path_factory):
    """A robot in a room with a niche: 70 scans of the beams ahead; scan 3 has no valid one, 4 a NaN."""
    niche = [[0, 0], [6, 0], [6, 4], [7.5, 4], [7.5, 6], [0, 6]]
    room = make_walls(niche, [[2.6, 2.6], [3.4, 2.6], [3.4, 2.9]])
    world = dataclasses.replace(square(beams=2 * (BEAMS - 1)), walls=room)
    log = jax.device_get(scan_world(world, jax.random.key(0)))
    ahead = slice(BEAMS // 2, BEAMS // 2 + BEAMS)  # from -90° to 90°, 7.5° apart
    assert np.isclose(log.beams.angle[0, ahead][0], -np.pi / 2)
    ranges = np.where(log.beams.valid, log.beams.range, 0.0)[:STEPS, ahead]
    ranges[3], ranges[4, 5] = 0.0, np.nan
    path = tmp_path_factory.mktemp("log") / "room.log"
    raw = log.pose + [10.0, -3.0, 0.0]
    text = "".join(line(ranges[k], log.pose[k], raw[k], 100 + 0.25 * k) for k in range(STEPS))
    path.write_text("# comment\n" + text)
    lost = int((~(ranges > 0)).sum())
    return SimpleNamespace(path=path, pose=log.pose[:STEPS], walls=world.walls, lost=lost)


def run(command, path, out, *options):
    return cli.main([command, str(path), "--out", str(out), *options])


def test_a_map_at_known_poses_is_one_that_ros_reads(log_file, tmp_path, capsys):
    out = tmp_path / "out"
    assert run("map", log_file.path, out, "--resolution", "0.1", "--max-range", "10") == 0
    assert "without a valid beam 1" in capsys.readouterr().out
    assert {path.name for path in out.iterdir()} == {
        *("map.yaml", "map.pgm", "map.png", "trajectory.csv", "trajectory.tum", "summary.json")
    }
    grid = datasets.read_map(out / "map.yaml")
    centres = np.asarray(grids.centers(grid))
    free = np.asarray(grid.log_odds) < 0
    assert free.sum() > 1000
    assert is_free(log_file.walls, centres[free]).mean() > 0.98
    rows = np.loadtxt(out / "trajectory.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(rows[:, 0], 100 + 0.25 * np.arange(STEPS))
    np.testing.assert_allclose(rows[:, 1:4], log_file.pose, atol=1e-7)
    assert len((out / "trajectory.tum").read_text().splitlines()) == STEPS
    summary = json.loads((out / "summary.json").read_text())
    assert summary["dropped by the reader"] == {
        "comments": 1,
        "beams without a range": log_file.lost,
    }
    beams = summary["beams"]
    assert sum(beams.values()) == STEPS * BEAMS
    assert beams["without a range, or padding"] >= BEAMS
    assert 0 < summary["mean entropy of a known cell [bit]"] < 1


def test_scans_are_chosen_and_those_left_out_are_counted(log_file, tmp_path):
    out = tmp_path / "out"
    chosen = ["--resolution", "0.1", "--scans", "10:31", "--every", "2"]
    assert run("map", log_file.path, out, *chosen) == 0
    rows = np.loadtxt(out / "trajectory.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(rows[:, 0], 100 + 0.25 * np.arange(10, 31, 2))
    left_out = json.loads((out / "summary.json").read_text())["scans left out"]
    assert left_out == {
        "outside --scans": STEPS - 21,
        "skipped by --every": 10,
        "without a valid beam": 0,
    }


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["slam", "--filters", "seif"], "unrecognized arguments: --filters"),
        (["map", "--animate"], "unrecognized arguments: --animate"),
        (["slam", "--relations", "no.txt"], "no.txt: cannot be read: No such file"),
        (["map", "--resolution", "0"], "--resolution: expected a number above 0"),
        (["map", "--resolution", "1e-4"], "--resolution: cells of 0.0001 m make a map"),
        (["map", "--max-range", "-1"], "--max-range: expected a number above 0"),
        (["map", "--every", "0"], "--every: expected a number above 0"),
        (["map", "--mount", "-1,0"], "--mount: expected X,Y,HEADING [m, m, deg], got '-1"),
        (["map", "--mount", "0,nan,0"], "--mount: expected X,Y,HEADING [m, m, deg]"),
        (["map", "--laser", "RLASER"], "room.log:141: expected scans of the laser RLASER"),
        (["map", "--odometry", "no.txt"], "no.txt: cannot be read: No such file"),
        (["map", "--scans", "a:b"], "--scans: expected A:B"),
        (["map", "--scans", "900:"], "--scans: 900: has none of the 70 scans"),
        (["map", "--scans", "3:4"], "room.log: none of 1 scans has a valid beam"),
        (["map", "--figures", "gif"], "--figures: expected formats"),
        (["map", "--max-range", "0.01"], "room.log: no beam returns within 0.01 m (--max-range)"),
        (["localize", "m.bag"], "expected a map of ROS, NAME.yaml, got m.bag"),
        (["localize", "m.yaml", "--scans", "-3:3"], "--scans: -3:3 has none of the 70 scans"),
    ],
)
def test_options_that_do_not_fit_are_refused(log_file, tmp_path, refused, options, message):
    out = tmp_path / "out"
    refused([*options, log_file.path, "--out", out], message)
    assert not out.exists()


def test_a_log_that_ends_in_a_line_is_refused_with_the_line(log_file, tmp_path, refused):
    short, out = tmp_path / "short.log", tmp_path / "out"
    short.write_text(log_file.path.read_text()[:-40])
    refused(
        ["map", short, "--out", out], f"short.log:{2 * STEPS + 1}: expected {BEAMS + 11} fields"
    )
    assert not out.exists()


def test_laser_slam_writes_a_film_of_the_map_growing(log_file, tmp_path, capsys, undrawn, films):
    out = tmp_path / "out"
    assert run("slam", log_file.path, out, "--scans", ":2", "--max-range", "10", "--animate") == 0
    assert "\nfilm: ffmpeg is not installed: GIF instead of MP4\n" in capsys.readouterr().out
    assert (out / "film.gif").read_bytes().startswith(b"GIF")
    assert "data:image/png;base64," in (out / "film.html").read_text()
    (film,) = films
    assert film.title == "room"
    assert [film.caption(k) for k in range(3)] == [
        "laser odometry, scan 1 of 2",
        "laser odometry, scan 2 of 2",
        "after closing by 0 loops",
    ]
    score = json.loads((out / "summary.json").read_text())["score"]
    assert score == "none: the path is shorter than 1 m"


@pytest.fixture(scope="module")
def room_map(log_file, tmp_path_factory):
    """A map of the room, as another program would have made it."""
    path = tmp_path_factory.mktemp("map") / "room.yaml"
    datasets.write_map(path, rasterize(log_file.walls, 0.1))
    return path


def test_a_robot_is_localized_in_a_map_by_odometry_and_scans(log_file, room_map, tmp_path, capsys):
    out = tmp_path / "out"
    options = [str(log_file.path), "--max-range", "10", "--particles", "500"]
    assert run("localize", room_map, out, *options) == 0
    capsys.readouterr()
    assert {path.name for path in out.iterdir()} == {
        *("localization.png", "trajectory.csv", "trajectory.tum", "summary.json")
    }
    rows = np.loadtxt(out / "trajectory.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(rows[:, 0], 100 + 0.25 * np.arange(STEPS))
    error = np.hypot(*(rows[:, 1:3] - log_file.pose[:, :2]).T)
    assert np.median(error) < 0.3 and error[-1] < 0.3
    summary = json.loads((out / "summary.json").read_text())
    assert summary["from the poses in the file, median [m]"] == pytest.approx(np.median(error))
    assert summary["scans left out"]["without a valid beam"] == 1
    assert 0 < summary["particles in use, mean"] <= 500
    assert summary["hypotheses at the end"] >= 1
    assert summary["particles agree at the end"] is (summary["weight of the heaviest"] > 0.5)
    assert summary[FIT] > 0.9
    assert summary["localized at the end"] == "yes"
    assert run("localize", room_map, tmp_path / "lost", *options, "--start", "5,5,90") == 0
    summary = json.loads((tmp_path / "lost" / "summary.json").read_text())
    assert summary["particles agree at the end"] and summary[FIT] < 0.6
    assert summary["localized at the end"] == "no: less than 75% of the beams fit the map"


@pytest.fixture(scope="module", params=[(-0.2, 0.1, np.pi), (0.5, 0, 0)], ids=["back", "ahead"])
def mounted(request, log_file, tmp_path_factory):
    """The same drive with a laser that looks back, or ahead from the front of the robot."""
    mount, step = np.array(request.param), np.pi / (BEAMS - 1)
    laser = poses.compose(log_file.pose, mount)
    angles = -np.pi / 2 + step * np.arange(BEAMS)
    raw = log_file.pose + [10.0, -3.0, 0.0]
    text = ""
    for k, t in enumerate(100 + 0.25 * np.arange(STEPS)):
        seen = ranges_of(laser[k], angles, log_file.walls.segments)
        numbers = " ".join(f"{r:.4f}" for r in seen)
        both = " ".join(f"{value}" for value in (*laser[k], *log_file.pose[k]))
        text += (
            f"ODOM {raw[k][0]} {raw[k][1]} {raw[k][2]} 0 0 0 {t} robot {t}\n"
            f"ROBOTLASER1 0 {angles[0]} {np.pi} {step} {FAR} 0.1 0 {BEAMS} {numbers} 0 {both} "
            f"0 0 0 0 0 {t} robot {t}\n"
        )
    path = tmp_path_factory.mktemp("mounted") / "room.log"
    path.write_text(text)
    return SimpleNamespace(path=path, mount=mount, pose=log_file.pose)


@pytest.mark.sweep
def test_a_map_by_a_laser_on_a_mount(log_file, mounted, tmp_path):
    out = tmp_path / "out"
    options = ["--resolution", "0.1"]
    assert run("map", mounted.path, out, *options) == 0
    grid = datasets.read_map(out / "map.yaml")
    free = np.asarray(grid.log_odds) < 0
    assert free.sum() > 1000
    assert is_free(log_file.walls, np.asarray(grids.centers(grid))[free]).mean() > 0.98
    rows = np.loadtxt(out / "trajectory.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(rows[:, 1:3], mounted.pose[:, :2], atol=1e-6)
    summary = json.loads((out / "summary.json").read_text())
    x, y, heading = summary["mount of the laser [m, m, deg]"]
    np.testing.assert_allclose([x, y, np.deg2rad(heading)], mounted.mount, atol=1e-6)
    given = [f"{mounted.mount[0]}", f"{mounted.mount[1]}", f"{np.rad2deg(mounted.mount[2])}"]
    assert run("map", mounted.path, tmp_path / "given", *options, "--mount", ",".join(given)) == 0
    again = datasets.read_map(tmp_path / "given" / "map.yaml")
    assert (again.log_odds == grid.log_odds).mean() > 0.99


@pytest.mark.sweep
def test_a_robot_is_localized_by_a_laser_on_a_mount(mounted, room_map, tmp_path):
    out = tmp_path / "out"
    assert run("localize", room_map, out, str(mounted.path), "--particles", "500") == 0
    rows = np.loadtxt(out / "trajectory.csv", delimiter=",", skiprows=1)
    error = np.hypot(*(rows[:, 1:3] - mounted.pose[:, :2]).T)
    assert np.median(error) < 0.3 and error[-1] < 0.3
    summary = json.loads((out / "summary.json").read_text())
    assert summary["localized at the end"] == "yes" and summary[FIT] > 0.9


def test_odometry_of_a_file_takes_the_place_of_the_logs(log_file, tmp_path):
    text = "".join(f"{100 + 0.25 * k} {k / 10} 0 0\n" for k in range(STEPS))
    (tmp_path / "odometry.txt").write_text(text)
    paths = {"path": log_file.path, "odometry": tmp_path / "odometry.txt"}
    rest = {
        "max_range": 10.0,
        "laser": None,
        "mount": None,
        "dataset": None,
        "scans": ":",
        "every": 2,
    }
    log, _ = cli.laser_log.read_log(SimpleNamespace(**paths, **rest))
    np.testing.assert_allclose(log.raw[:, 0], np.arange(0, STEPS, 2) / 10)
    assert log.odometry_known.shape == (STEPS // 2,)


@pytest.fixture(scope="module")
def bag(log_file, tmp_path_factory):
    """The log of CARMEN as a bag of ROS 2."""
    log = bags.first(datasets.carmen(log_file.path, max_range=10.0), STEPS)
    return bags.write(tmp_path_factory.mktemp("bag"), bags.of_log(log), "mcap", name="room")


def command(*words):
    return cli.main(list(map(str, words)))


def test_the_contents_of_a_bag_are_listed(bag, log_file, capsys, refused):
    assert command("run", "--dataset", "rosbag", bag, "--list") == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split() for line in lines[:4]] == [
        ["type", "messages"],
        ["/odom", "nav_msgs/Odometry", f"{STEPS}"],
        ["/scan", "sensor_msgs/LaserScan", f"{STEPS}"],
        ["/tf_static", "tf2_msgs/TFMessage", "1"],
    ]
    assert lines[4] == f"recorded from 100.000 s to {100 + 0.25 * (STEPS - 1):.3f} s: 17.250 s"
    assert lines[5] == "mount of /scan: (0, 0, 0°) on base_link"
    refused(["slam", log_file.path, "--list"], "room.log: cannot be read as a ROS bag")
    refused(["run", "--dataset", "rosbag", log_file.path], "cannot be read as a ROS bag")
    refused(["map", bag, "--out", log_file.path.parent / "map"], "with poses, and /scan has none")


def check_as_ros_reads_it(path):
    """Occupied, free and unknown cells by the rule of map_server, with a reader of its own."""
    of = yaml.safe_load(path.read_text())
    assert set(of) == {
        *("image", "mode", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")
    }
    assert (of["mode"], of["negate"], of["origin"][2]) == ("trinary", 0, 0.0)
    shade = np.asarray(Image.open(path.parent / of["image"]))[::-1]  # the first row is on top
    p = (255 - shade) / 255.0
    occupied, free = p > of["occupied_thresh"], p < of["free_thresh"]
    grid = datasets.read_map(path)
    np.testing.assert_array_equal(occupied, np.asarray(grid.log_odds) > 0)
    np.testing.assert_array_equal(free, np.asarray(grid.log_odds) < 0)
    assert occupied.any() and free.any() and not (occupied | free).all()
    np.testing.assert_allclose(grid.origin, of["origin"])
    assert float(grid.resolution) == of["resolution"]


def test_evo_reads_the_path(tmp_path):
    file_interface = broken.optional("evo.tools.file_interface")
    pose = np.array([[1.0, 2.0, 0.5], [1.5, 2.5, -3.0]])
    path = Estimate(pose, np.zeros((2, 3, 3)), *[np.zeros(0)] * 4)
    (tmp_path / "a.tum").write_text(report.trajectory_tum(np.array([1.7e9, 1.7e9 + 0.25]), path))
    found = file_interface.read_tum_trajectory_file(tmp_path / "a.tum")
    np.testing.assert_allclose(found.timestamps, [1.7e9, 1.7e9 + 0.25])
    np.testing.assert_allclose(found.positions_xyz[:, :2], pose[:, :2])
    np.testing.assert_allclose(found.get_orientations_euler()[:, 2], pose[:, 2])


def test_a_bag_gives_the_files_that_its_log_gives(bag, log_file, tmp_path, undrawn, capsys):
    chosen = ["--scans", ":2", "--max-range", "10", "--out"]
    assert command("run", "--dataset", "rosbag", bag, *chosen, tmp_path / "bag") == 0
    assert command("run", "--dataset", "carmen", log_file.path, *chosen, tmp_path / "log") == 0
    names = {path.name for path in (tmp_path / "log").iterdir()}
    assert {path.name for path in (tmp_path / "bag").iterdir()} == names
    assert {"trajectory.tum", "graph.g2o", "loops.csv", "map.yaml", "map.pgm"} < names
    assert "FIX" not in (tmp_path / "bag" / "graph.g2o").read_text()
    found, expected = (
        np.loadtxt(tmp_path / of / "trajectory.csv", delimiter=",", skiprows=1)
        for of in ("bag", "log")
    )
    np.testing.assert_allclose(found[:, :4], expected[:, :4], atol=1e-5)
    check_as_ros_reads_it(tmp_path / "bag" / "map.yaml")
    summary = json.loads((tmp_path / "bag" / "summary.json").read_text())
    assert summary["score"] == "none: the file has no poses"


@pytest.mark.parametrize("odometry", [True, False])
def test_the_robot_of_a_bag_is_localized(
    bag, log_file, room_map, tmp_path, undrawn, monkeypatch, odometry
):
    recording, out = bag, tmp_path / "out"
    if not odometry:
        log = bags.first(datasets.carmen(log_file.path, max_range=10.0), STEPS)
        recording = bags.write(tmp_path, [m for m in bags.of_log(log) if m.topic != "/odom"])
        solved = SimpleNamespace(odometry=log.raw)  # 25 beams are too few for laser odometry
        monkeypatch.setattr(cli.localize.laser_slam, "solve", lambda log: solved)
    x, y, heading = log_file.pose[0]
    start = f"{x},{y},{np.rad2deg(heading)}"
    options = ["--max-range", "10", "--particles", "500", "--start", start, "--out", out]
    assert command("run", "--dataset", "rosbag", recording, "--localize", room_map, *options) == 0
    rows = np.loadtxt(out / "trajectory.csv", delimiter=",", skiprows=1)
    error = np.hypot(*(rows[:, 1:3] - log_file.pose[:, :2]).T)
    assert np.median(error) < 0.3 and error[-1] < 0.3
    summary = json.loads((out / "summary.json").read_text())
    assert summary["localized at the end"] == "yes"
    assert summary["odometry"].startswith("of the log" if odometry else "laser odometry")
    assert summary["score"] == "none: the file has no poses"


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        (("", ""), ["--start", "9,9,0"], "--start: the pose (9 m, 9 m, 0°) is off the map"),
        (("", ""), ["--start", "here"], "--start: expected file, global or X,Y,HEADING"),
        (("image: room.pgm", "image: no.pgm"), [], "room.yaml:1: no image"),
        (
            ("", ""),
            ["--start", "-60,-.5,90"],
            "--start: the pose (-60 m, -0.5 m, 90°) is off the map",
        ),
        (("negate: 0", "negate: 1"), [], "room.yaml: the map has no free cell"),
    ],
)
def test_a_map_or_a_start_that_is_none_is_refused(
    log_file, room_map, tmp_path, refused, change, options, message
):
    here, out = tmp_path / "room.yaml", tmp_path / "out"
    text = room_map.read_text()
    assert change[0] in text
    here.write_text(text.replace(*change))
    full = "negate: 1" in change  # then white is occupied
    image = b"P5\n2 1\n255\n\xff\xff" if full else room_map.with_suffix(".pgm").read_bytes()
    (tmp_path / "room.pgm").write_bytes(image)
    run = ["localize", here, log_file.path, "--out", out]
    refused([*run, *options], message)
    assert not out.exists()


def test_memory_is_returned_after_each_compilation_in_the_block(monkeypatch):
    calls = []
    monkeypatch.setattr(cli.recorded.memory, "trim", lambda: calls.append(None))
    with cli.recorded.memory.memory_returned():
        jax.jit(lambda x: x + 0.25)(np.ones(3))
    count = len(calls)
    jax.jit(lambda x: x + 0.5)(np.ones(3))
    assert count == len(calls) == 1


def test_memory_can_be_returned():
    cli.recorded.memory.trim()
