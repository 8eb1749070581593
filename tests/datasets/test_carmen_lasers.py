"""Lasers of a log: which is read, its maximum range, and where it is mounted."""

import numpy as np
import pytest

from jaxslam import datasets
from jaxslam.datasets._laser_logs.laser_beams import _code_of_no_return
from jaxslam.math import numpy_poses as poses

MOUNT = np.array([0.2, -0.1, np.pi])
ROBOT = np.array([[1.0, 2.0, 0.5], [3.0, 1.0, -2.0], [4.0, 1.5, 3.0]])


def numbers(values):
    return " ".join(f"{value:.6f}" for value in values)


def line(kind, robot, mount=(0, 0, 0), t=1.0, far=5.6, ranges="5.6 2.0 8.183", laser=None):
    """A line with three beams, of any kind."""
    laser = poses.compose(np.array(robot), np.array(mount, float)) if laser is None else laser
    if kind in ("FLASER", "RLASER"):
        return f"{kind} 3 {ranges} {numbers(laser)} {numbers(robot)} {t} host 0.5"
    head = f"{kind} 0 -1.570796 3.141593 1.570796 {far} 0.01 0 3 {ranges} 0 "
    if kind.startswith("RAWLASER"):
        return head + f"{t} host 0.5"
    return head + f"{numbers(laser)} {numbers(robot)} 0 0 0 0 0 {t} host 0.5"


@pytest.fixture
def read(tmp_path):
    def reading(*lines, **options):
        (tmp_path / "a.log").write_text("\n".join(lines) + "\n")
        return datasets.carmen(tmp_path / "a.log", **options)

    return reading


def test_a_range_at_the_maximum_that_a_line_states_met_nothing(read):
    log = read(line("ROBOTLASER1", ROBOT[0]))
    assert log.max_range == 5.6
    np.testing.assert_allclose(log.beams.range, [[5.6, 2.0, 5.6]])
    assert log.beams.valid.all()
    assert read(line("ROBOTLASER1", ROBOT[0]), max_range=2.0).max_range == 2.0


def test_maximum_ranges_that_differ_hold_each_for_its_scan(read):
    log = read(line("ROBOTLASER1", ROBOT[0]), line("ROBOTLASER1", ROBOT[1], far=8.0))
    assert log.max_range == 8.0
    np.testing.assert_allclose(log.beams.range, [[8.0, 2.0, 8.0], [5.6, 2.0, 8.0]])
    assert any(what.startswith("maximum ranges differ") for what in log.corrections)


@pytest.mark.parametrize("far", ["0", "-1", "inf", "nan"])
def test_a_maximum_range_that_is_none_is_told(read, far):
    log = read(line("ROBOTLASER1", ROBOT[0], far=far))
    assert log.max_range == 50.0
    np.testing.assert_allclose(log.beams.range, [[5.6, 2.0, 8.183]])
    assert any(what.endswith("which take max_range: 1") for what in log.corrections)
    with pytest.raises(ValueError, match=r"a\.log:1: the maximum range is not a number: 'far'"):
        read(line("ROBOTLASER1", ROBOT[0], far="far"))


@pytest.mark.parametrize(
    ("kind", "mount"), [("ROBOTLASER1", MOUNT), ("FLASER", MOUNT), ("RLASER", (-0.1, 0, np.pi))]
)
def test_the_mount_is_that_of_the_lines(read, kind, mount):
    log = read(*(line(kind, robot, mount, t) for t, robot in enumerate(ROBOT)))
    np.testing.assert_allclose(poses.between(log.mount, np.array(mount)), 0, atol=1e-5)
    np.testing.assert_allclose(log.corrected, ROBOT, atol=1e-5)
    np.testing.assert_allclose(log.raw, ROBOT, atol=1e-5)
    np.testing.assert_allclose(log.time, [0, 1, 2])


@pytest.mark.parametrize(("kind", "mount"), [("FLASER", (0, 0, 0)), ("RLASER", (0, 0, np.pi))])
def test_two_poses_that_differ_by_no_constant_are_a_correction(read, kind, mount):
    drift = [(0.1 * t, 0.02 * t, 0.03 * t) for t in range(len(ROBOT))]
    log = read(
        *(
            line(kind, robot, off, t)
            for t, (robot, off) in enumerate(zip(ROBOT, drift, strict=True))
        )
    )
    np.testing.assert_array_equal(log.mount, mount)
    assert any("do not differ by a constant mount" in what for what in log.corrections)


def test_a_mount_that_is_given_takes_the_place_of_that_of_the_lines(read):
    lines = [line("FLASER", robot, MOUNT, t) for t, robot in enumerate(ROBOT)]
    log = read(*lines, mount=MOUNT)
    np.testing.assert_array_equal(log.mount, MOUNT)
    np.testing.assert_allclose(log.corrected, ROBOT, atol=1e-5)
    twice = read(*(line("FLASER", robot) for robot in ROBOT), mount=MOUNT)
    np.testing.assert_allclose(twice.corrected, ROBOT, atol=1e-5)


@pytest.mark.parametrize("mount", [(0, 0), (0, 0, np.nan), "ahead", ((0, 0, 0),)])
def test_a_mount_that_is_none_is_refused(read, mount):
    with pytest.raises(
        ValueError, match=r"^carmen: mount: expected finite numbers of shape \(3,\), got"
    ):
        read(line("FLASER", ROBOT[0]), mount=mount)


def test_a_mount_that_differs_between_lines_is_refused_unless_it_is_given(read):
    lines = line("ROBOTLASER1", ROBOT[0], MOUNT), line("ROBOTLASER1", ROBOT[1], (0.25, -0.1, np.pi))
    with pytest.raises(
        ValueError, match=r"a\.log:2: the laser is at .* in line 1 at \(0\.2, -0\.1, "
    ):
        read(*lines)
    np.testing.assert_array_equal(read(*lines, mount=np.zeros(3)).mount, np.zeros(3))


def test_one_laser_is_read_and_scans_of_the_others_are_counted(read):
    lines = [line("FLASER", ROBOT[0]), *(line("RLASER", robot) for robot in ROBOT[:2])]
    lines += [line("RAWLASER1", robot) for robot in ROBOT]
    assert read(*lines).dropped == {"scans FLASER": 1, "scans RAWLASER1": 3}
    assert read(lines[0], *lines[2:]).dropped == {"scans RLASER": 1, "scans RAWLASER1": 3}
    log = read(*lines, laser="FLASER")
    assert len(log.time) == 1 and log.dropped == {"scans RLASER": 2, "scans RAWLASER1": 3}
    with pytest.raises(
        ValueError, match=r"a\.log:6: expected scans of the laser ROBOTLASER2, got 1"
    ):
        read(*lines, laser="ROBOTLASER2")


def test_a_log_without_poses_has_the_odometry_of_its_lines_or_none(read):
    lines = [line("RAWLASER1", robot, t=t) for t, robot in enumerate(ROBOT)]
    log = read(*lines)
    assert (log.laser, log.placed, log.max_range) == ("RAWLASER1", False, 5.6)
    assert not log.raw.any() and not log.corrected.any()
    np.testing.assert_array_equal(log.odometry_known, [True, False, False])
    assert len(log.corrections) == 2
    moved = [f"ODOM {numbers(robot)} 0 0 0 1 host 1" for robot in ROBOT]
    log = read(*(one for pair in zip(moved, lines, strict=True) for one in pair))
    np.testing.assert_allclose(log.raw, ROBOT)
    assert log.odometry_known.all() and not log.corrected.any()
    np.testing.assert_allclose(log.beams.angle[0], [-1.570796, 0, 1.570796])


def office(count, largest=12.0, seed=0):
    """Ranges in rooms, none favoured, the farthest of them rare."""
    return largest * np.random.default_rng(seed).beta(1.2, 4.0, count)


def test_the_sign_that_a_beam_met_nothing_is_found_in_the_ranges():
    walls = office(5000)
    signs = np.random.default_rng(1).choice([32.763, 32.767], 300)
    code = _code_of_no_return(np.concatenate([walls, signs]))
    assert walls.max() < code < signs.min() and code > 32.0
    # A few walls as far as that change nothing, if signs are many more.
    far = np.array([31.0, 32.2])
    code = _code_of_no_return(np.concatenate([walls, far, signs]))
    assert far.max() < code < signs.min()


def test_a_far_wall_that_is_seen_often_is_no_sign():
    """A hall of 30 m: beams beside that to the middle of its wall meet it a little farther on."""
    bearing = np.linspace(-0.8, 0.8, 4000)
    wall = 30.0 / np.cos(bearing)
    noise = np.random.default_rng(2).normal(scale=0.01, size=len(wall))
    assert _code_of_no_return(np.concatenate([office(4000), wall + noise])) is None
    # The end of a corridor, through a door, as a log to a centimetre has it.
    end = np.random.default_rng(4).normal(10.0, 0.01, 300).round(2)
    assert _code_of_no_return(np.concatenate([office(10_000, 6.0), end])) is None
    # And one that is seen while the robot drives up to it.
    distance = np.random.default_rng(3).uniform(5.0, 30.0, 4000)
    assert _code_of_no_return(np.concatenate([office(4000), distance])) is None


def test_ranges_that_show_no_sign_have_none():
    assert _code_of_no_return(office(5000)) is None
    few = np.concatenate([office(900), np.full(80, 32.76)])
    assert _code_of_no_return(few) is None
    assert _code_of_no_return(np.zeros(0)) is None
    # Fewer than one beam in 500.
    assert _code_of_no_return(np.concatenate([office(5000), np.full(8, 32.76)])) is None
    assert _code_of_no_return(np.concatenate([office(5000), np.full(12, 32.76)])) is not None


def test_a_log_with_the_sign_says_so_and_its_beams_met_nothing(read):
    random = np.random.default_rng(4)
    lines = []
    for k in range(12):
        ranges = office(100, seed=k)
        none = random.random(100) < 0.1
        ranges[none] = random.choice([32.763, 32.767], none.sum())
        told = " ".join(f"{value:.3f}" for value in ranges)
        lines.append(f"FLASER 100 {told} 0 0 0 0 0 0 {k} host {k}")
    log = read(*lines)
    assert 12.0 < log.max_range < 32.755
    met = np.asarray(log.beams.range) < log.max_range
    assert 0.85 < met.mean() < 0.95 and log.beams.range[met].max() < 12.0
    assert any("are read as no return" in what for what in log.corrections)
    assert (np.asarray(log.beams.range)[~met] == log.max_range).all()
