"""Raw odometry of laser logs: lines that set it, lines that are missing, and a file in its place."""

import gzip

import numpy as np
import pytest

from benchmarks.real_data import DATA
from jaxslam import datasets
from jaxslam.math import numpy_poses as poses

STEPS = np.random.default_rng(1).normal([0.3, 0, 0.1], [0.1, 0.05, 0.3], (24, 3))
"""Of the wheels, three to a scan."""
SLIPS = np.random.default_rng(2).normal(0, [0.05, 0.05, 0.1], (8, 3))
"""What a program corrects at each scan."""


def odom(pose, t):
    return f"ODOM {pose[0]:.6g} {pose[1]:.6g} {pose[2]:.6g} 0 0 0 {t} host {t}"


def flaser(laser, robot, t):
    numbers = " ".join(f"{value:.6g}" for value in (*laser, *robot))
    return f"FLASER 3 1 2 3 {numbers} {t} host {t}"


def corrected_log(stamp, whole=True):
    """Lines of a log whose odometry is set to the corrected pose after each scan, and the path of
    the wheels at the scans."""
    wheels = poses.chain(np.zeros(3), STEPS)
    at, lines = np.zeros(3), [odom(np.zeros(3), 0)]
    for k, slip in enumerate(SLIPS):
        for j in range(3 * k, 3 * k + 3):
            at = poses.compose(at, STEPS[j])
            lines.append(odom(at, j + 1))
        at = poses.compose(at, slip)
        lines.append(flaser(at, at, 3 * k + 3))
        if whole or k % 3:
            lines.append(odom(at, stamp(3 * k + 3)))
        else:
            at = poses.compose(at, poses.inverse(slip))
    return lines, wheels[3::3]


def test_a_scan_that_is_written_before_the_line_of_its_pose_sets_nothing(tmp_path):
    """Half of the motion of a raw log leads to such lines: it is motion."""
    path = np.cumsum(np.full((21, 3), [1.0, 0.0, 0.0]), axis=0)
    lines = [odom(path[0], 0)]
    for k in range(1, 20, 2):
        lines += [
            odom(path[k], k),
            flaser(path[k + 1], path[k + 1], k + 1),
            odom(path[k + 1], k + 1),
        ]
    file = tmp_path / "a.log"
    file.write_text("\n".join(lines) + "\n")
    log = datasets.carmen(file)
    np.testing.assert_allclose(log.raw, path[1:20:2], atol=1e-6)
    (note,) = log.corrections
    assert note.startswith("10 lines ODOM repeat the pose of the scan before them")
    assert note.endswith("they are motion, since the steps to them are 50 % of the way ahead")


@pytest.mark.parametrize(
    ("stamp", "whole"), [(lambda t: 0, True), (lambda t: t, True), (lambda t: 0, False)]
)
def test_lines_that_set_the_odometry_are_no_motion(tmp_path, stamp, whole):
    lines, wheels = corrected_log(stamp, whole)
    path = tmp_path / "a.log"
    path.write_text("\n".join(lines) + "\n")
    log = datasets.carmen(path)
    np.testing.assert_allclose(log.raw, wheels, atol=1e-4)
    assert len(log.odometry) == sum(line.startswith("ODOM") for line in lines)
    np.testing.assert_allclose(log.odometry[log.row], log.raw, atol=1e-12)
    assert log.odometry_known.all()
    apart = poses.between(log.raw[0], log.raw) - poses.between(log.corrected[0], log.corrected)
    far = np.hypot(apart[:, 0], apart[:, 1])
    *judged, told = log.corrections
    # With stamps that never go back only the motion tells, and the reader says so.
    assert ["they set the odometry" in note for note in judged] == ([True] if stamp(1) else [])
    assert told.startswith(
        f"ODOM lines that set the odometry to the pose of the scan before: {8 if whole else 5}; "
    )
    assert told.endswith(f"by up to {far.max():.2f} m, {far[-1]:.2f} m at the end")


def raw_log(late):
    """Lines of a raw log; each `late`-th line ODOM is written after the scan that has its pose."""
    lines = [odom(np.zeros(3), 0)]
    wheels = poses.chain(np.zeros(3), STEPS)
    for k in range(1, 25):
        pair = [odom(wheels[k], k), flaser(wheels[k], wheels[k], k)]
        lines += pair[::-1] if k % late == 0 else pair
    return lines, wheels[1:]


@pytest.mark.parametrize("late", [1, 4, 25])
def test_a_raw_log_that_repeats_poses_is_read_as_it_stands(tmp_path, late):
    """The line after a scan has its pose by the order of writing, and stamps that go on."""
    lines, wheels = raw_log(late)
    path = tmp_path / "a.log"
    path.write_text("\n".join(lines) + "\n")
    log = datasets.carmen(path)
    want = [[float(x) for x in line.split()[1:4]] for line in lines if line.startswith("ODOM")]
    np.testing.assert_allclose(log.odometry[:, :2], np.array(want)[:, :2], atol=1e-12)
    behind = np.arange(1, 25) % late == 0
    before = np.vstack([np.zeros(3), wheels[:-1]])
    np.testing.assert_allclose(log.raw, np.where(behind[:, None], before, wheels), atol=1e-4)


def test_scans_without_a_line_of_odometry_are_told(tmp_path):
    lines, _ = corrected_log(lambda t: 0)
    kept = [line for k, line in enumerate(lines) if k < 6 or not line.startswith("ODOM")]
    path = tmp_path / "a.log"
    path.write_text("\n".join(kept) + "\n")
    log = datasets.carmen(path)
    np.testing.assert_array_equal(log.odometry_known, [True] + [False] * 7)
    np.testing.assert_allclose(log.raw, np.broadcast_to(log.raw[0], (8, 3)), atol=1e-12)
    assert log.corrections[-1] == (
        "scans without an ODOM line since the previous scan, with a zero step: 7"
    )


def scans(times):
    return "".join(flaser((t, 0, 0), (t, 0, 0), t) + "\n" for t in times)


def read(tmp_path, times, text):
    (tmp_path / "a.log").write_text(odom((0, 0, 0), 0) + "\n" + scans(times))
    (tmp_path / "odometry.txt.gz").write_bytes(gzip.compress(text.encode()))
    return datasets.carmen(tmp_path / "a.log", odometry=tmp_path / "odometry.txt")


def test_odometry_of_a_file_joins_by_stamp(tmp_path):
    text = "# t x y theta\n1 10 0 0\n3.0004 30 0 1\n2 20 0 0\n9 0 0 0\n"
    log = read(tmp_path, (1, 2, 3), text)
    np.testing.assert_allclose(log.raw[:, 0], [10, 20, 30])
    np.testing.assert_array_equal(log.row, [0, 2, 1])
    np.testing.assert_allclose(log.time, [1, 2, 3])
    assert log.odometry_known.all() and log.dropped == {"lines ODOM": 1}
    assert log.corrections[0].endswith("4 lines, 3 of them joined to the 3 scans by stamp")


def test_as_many_lines_as_scans_join_in_order_where_no_stamp_does(tmp_path):
    log = read(tmp_path, (1, 2, 3), "101 10 0 0\n102 20 0 0\n103.5 30 0 1\n")
    np.testing.assert_allclose(log.raw[:, 0], [10, 20, 30])
    np.testing.assert_allclose(log.time, [101, 102, 103.5])
    assert log.corrections[0].endswith("joined to as many scans in order, which take their stamps")


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (
            "1 0 0 0\n7 0 0 0\n",
            r" stamps from 1\.0+ s to 7\.0+ s join 1 of the 3 scans of .*a\.log, ",
        ),
        ("2 0 0 0\n1 0 0 0\n7 0 0 0\n", ".* join 2 of the 3 scans"),
        ("103 0 0 0\n102 0 0 0\n101 0 0 0\n", ".* join 0 of the 3 scans"),
        ("1 0 0 0\n2 0 0\n", r"2: expected 4 fields \(t x y theta\), got 3"),
        ("1 0 0 0\n2 0 0 up\n", "2: theta is not a finite number"),
        ("# nothing\n", "1: expected lines t x y theta, got none"),
    ],
)
def test_a_file_of_odometry_that_does_not_fit_is_refused(tmp_path, text, why):
    with pytest.raises(ValueError, match=r"odometry\.txt\.gz:" + why) as caught:
        read(tmp_path, (1, 2, 3), text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("log", "file", "told"),
    [
        (
            "laser_graphs/mit-cscail",
            "csail",
            "1,988 lines, 1,051 of them joined to the 1,051 scans",
        ),
        ("carmen/intel-corrected", "intel", "910 lines, joined to as many scans in order"),
    ],
)
def test_raw_odometry_of_the_public_benchmark(log, file, told):
    odometry = DATA / "relations" / f"{file}_raw_odometry.txt.gz"
    if not odometry.exists():
        pytest.skip("the public logs are not here")
    found = datasets.carmen(DATA / f"{log}.log", odometry=odometry)
    assert told in found.corrections[0]
    assert (found.time > 9e8).all()
    if file == "intel":  # four scans lie in the other order there
        own = datasets.carmen(DATA / f"{log}.log").raw
        off = poses.between(own[:-1], own[1:]) - poses.between(found.raw[:-1], found.raw[1:])
        assert (np.hypot(off[:, 0], off[:, 1]) > 1e-3).sum() == 12


def test_lines_that_set_the_odometry_after_scans_of_another_laser(tmp_path):
    """Such a line comes after FLASER; between it and the next, another laser is read."""
    lines, _ = corrected_log(lambda t: 0)
    path = tmp_path / "a.log"
    path.write_text("\n".join(lines) + "\n")
    odometry = datasets.carmen(path).odometry
    scan = "RAWLASER1 0 -1.5 3.0 1.5 50 0.1 0 3 1 2 3 0 {t} host {t}"
    two = [s for t, one in enumerate(lines) for s in (one, scan.format(t=t))]
    path.write_text("\n".join(two) + "\n")
    log = datasets.carmen(path, laser="RAWLASER1")
    assert len(log.time) == len(lines) and log.dropped == {"scans FLASER": 8}
    np.testing.assert_allclose(log.odometry, odometry, atol=1e-12)


@pytest.mark.parametrize(
    ("stamps", "backward"),
    [([0, 1, 1, 1, 2], 0), ([0, 2, 1, 3, 2.5], 2), ([0, 1, 1e9, 1e9 + 1, 2], 1)],
)
def test_stamps_that_repeat_run_backward_or_jump_change_no_pose(tmp_path, stamps, backward):
    """Lines count in their order; headings pass ±π."""
    at = [np.array([0.3 * k, 0.0, 3.0 + 0.1 * k]) for k in range(5)]
    path = tmp_path / "a.log"
    pairs = (
        (odom(pose, t), flaser(pose + 0.01, pose + 0.01, t))
        for pose, t in zip(at, stamps, strict=True)
    )
    path.write_text("\n".join(line for pair in pairs for line in pair) + "\n")
    log = datasets.carmen(path)
    off = log.raw - at
    np.testing.assert_allclose(off - [0, 0, 2 * np.pi] * np.round(off / (2 * np.pi)), 0, atol=1e-9)
    np.testing.assert_array_equal(log.time, stamps)
    told = f"scans stamped before their predecessor, kept in order: {backward}"
    assert (told in log.corrections) == (backward > 0)
