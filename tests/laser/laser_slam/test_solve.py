"""A small log from raw odometry to its map, and logs with something wrong in them."""

import dataclasses
import json

import jax
import numpy as np
import pytest
from cases import refused
from ring_of_rooms import FAR, SETTINGS, driven, errors, odometry_of, scans_of, steps_of
from worlds import nothing_compiled

from jaxslam import _cli as cli
from jaxslam import filters, laser_slam, metrics, run, sensors
from jaxslam.core.types import Beams, Log, Scan
from jaxslam.laser.laser_slam import (
    LoopOutcome,
    _end_covariances,
    _log_map,
)
from jaxslam.math import numpy_poses as poses
from jaxslam.results._files import write_files

ONCE = dataclasses.replace(SETTINGS, rounds=1)  # and so fewer programs


@pytest.fixture(scope="module")
def drive():
    true, log = driven()
    return true, log, laser_slam.solve(log, SETTINGS)


def test_loops_close(drive):
    true, log, solved = drive
    position, heading = errors(solved.poses, true)
    before, _ = errors(solved.odometry, true)
    raw, _ = errors(solved.raw, true)
    assert position.max() < 0.1 and heading.max() < np.deg2rad(1.5)
    assert position.mean() < before.mean() < raw.mean()
    score = laser_slam.closure_score(solved, true)
    assert score.kept >= 5 and score.precision == 1.0 and score.recall > 0.5


def test_the_covariances_are_of_the_right_size(drive):
    """The mean NEES of a run: its poses are correlated, so the band is wide."""
    true, _, solved = drive
    error = solved.poses[1:] - true[1:]
    error[:, 2] = np.angle(np.exp(1j * error[:, 2]))
    nees = np.einsum("ki,kij,kj->k", error, np.linalg.inv(solved.cov[1:]), error)
    assert 0.02 < nees.mean() < 9
    assert 0.02 < solved.chi2 / solved.dof < 2


def test_a_filter_is_driven_by_the_matches(drive):
    """It follows laser odometry, and its covariance is that of the chain of matches."""
    _, log, solved = drive
    of = scans_of(log), steps_of(log.raw)
    odometry = odometry_of(*of, log.raw[0])
    keys = odometry.keyframe
    control = laser_slam.match_controls(odometry)
    np.testing.assert_allclose(laser_slam.match_controls(solved), control, rtol=1e-6, atol=1e-12)
    nothing = len(control), 1
    scan = Scan(np.zeros((*nothing, 2)), np.full(nothing, -1), np.zeros(nothing, bool))
    ekf = filters.DeadReckoning(laser_slam.MatchMotion(), sensors.RangeBearing(np.eye(2)))
    start = log.raw[0], np.zeros((3, 3))
    path = run(ekf, Log(control, scan), *start, jax.random.key(0)).estimate
    np.testing.assert_allclose(path.pose, odometry.poses[keys], atol=1e-9)
    cov = np.zeros((3, 3))
    for row, key in enumerate(keys[1:], 1):
        cov = _end_covariances.composed_cov(cov, odometry.z[key], odometry.cov[key])
        expected = _end_covariances.of_coordinates(cov, odometry.poses[key])
        np.testing.assert_allclose(path.pose_cov[row], expected, rtol=1e-9, atol=1e-15)
    with pytest.raises(
        ValueError, match="match_controls: of: expected Odometry or Solved, got int"
    ):
        laser_slam.match_controls(1)


def test_maps_of_a_film_grow_to_the_whole(drive):
    _, log, solved = drive
    grown, until = _log_map.growing_maps(
        log, solved.odometry, SETTINGS, frames=4, others=[solved.poses]
    )
    (final,), _ = _log_map.growing_maps(
        log, solved.odometry, SETTINGS, frames=1, others=[solved.poses]
    )
    assert until[-1] == len(log.time) and len(grown) == len(until) <= 4
    np.testing.assert_array_equal(grown[-1].log_odds, final.log_odds)
    cells = [(grid.log_odds != 0).sum() for grid in grown]
    assert (np.diff(cells) > 0).all()


def test_the_map_is_of_the_walls(drive):
    true, log, solved = drive
    grid = solved.map
    occupied = np.argwhere(grid.log_odds > 0)[:, ::-1] * 0.1 + 0.05 + grid.origin[:2]
    ends = log.beams.range < FAR
    angle = true[:, 2:3] + log.beams.angle
    walls = true[:, None, :2] + log.beams.range[..., None] * np.stack(
        [np.cos(angle), np.sin(angle)], axis=-1
    )
    walls = walls[ends]
    gap = np.linalg.norm(occupied[:, None] - walls[None], axis=-1).min(axis=1)
    assert np.quantile(gap, 0.95) < 0.15
    assert grid.log_odds.shape == solved.map_before.log_odds.shape


def test_what_is_wrong_is_counted_and_the_run_goes_on(drive):
    """A scan without points, one of maximum ranges, a jump of odometry, time that runs backward."""
    true, log, _ = drive
    ranges, angles, valid = (np.array(part) for part in log.beams)
    valid[5], ranges[9], angles[5] = False, FAR, np.nan
    ranges[12, :3] = np.nan
    raw, time = log.raw.copy(), log.time.copy()
    raw[20:] += [40.0, -30.0, 0.0]
    time[30] -= 3.0
    bad = log._replace(time=time, raw=raw, beams=Beams(ranges, angles, valid))
    told = []
    solved = laser_slam.solve(bad, ONCE, progress=lambda *what: told.append(what))
    counts = solved.counts
    assert counts["scans with too few points"] == 2
    assert counts["jumps of raw odometry"] == 1
    assert counts["scans stamped before their predecessor"] == 1
    assert np.isfinite(solved.poses).all() and np.isfinite(solved.cov).all()
    assert errors(solved.poses, true)[0].max() < 0.3
    assert {what[0] for what in told} == {"odometry", "loop closing"}
    assert sum(counts[f"loops {o.name.lower()}"] for o in LoopOutcome) == counts["loops matched"]


@pytest.mark.sweep
def test_after_a_jump_a_match_is_right_or_refused(drive):
    """At each scan of the drive: the step from the one before is unknown, a metre and up to 90°."""
    true, log, _ = drive
    all_scans, refused = scans_of(log), 0
    for k in range(6, len(true)):
        at = np.arange(k - 5, k + 1)
        raw = log.raw[at] + np.where(at == k, 40.0, 0.0)[:, None] * [1, 0, 0]
        scans = jax.tree.map(lambda part, at=at: np.asarray(part)[at], all_scans)
        odometry = odometry_of(scans, steps_of(raw), raw[0])
        z = poses.between(true[at[odometry.base[5]]], true[k])
        off = poses.between(odometry.z[5], z)
        assert np.hypot(off[0], off[1]) < 0.2 or not odometry.matched[5], k
        assert off @ np.linalg.solve(odometry.cov[5], off) < 30, k
        refused += not odometry.matched[5]
    assert refused < 4


def test_a_match_with_another_place_is_in_doubt(drive):
    """At each scan of the drive: it is that of 17 scans later, of a corridor that looks alike."""
    true, log, _ = drive
    all_scans, matched, wrong, doubted = scans_of(log), 0, 0, 0
    for k in range(6, len(true)):
        at = np.arange(k - 5, k + 1)
        seen = np.append(at[:-1], (k + 17) % len(true))
        scans = jax.tree.map(lambda part, seen=seen: np.asarray(part)[seen], all_scans)
        steps = steps_of(log.raw[at])
        odometry = odometry_of(scans, steps, log.raw[k - 5])
        z = poses.between(true[at[odometry.base[5]]], true[k])
        off = poses.between(odometry.z[5], z)
        matched += odometry.matched[5]
        doubted += odometry.doubted[5]
        wrong += off @ np.linalg.solve(odometry.cov[5], off) > 30
        narrow = odometry.cov[5] - odometry.cov_if_right[5]
        assert np.any(narrow) == odometry.doubted[5] and np.linalg.eigvalsh(narrow).min() > -1e-12
    # A place within the error of raw odometry that looks the same cannot be told from this one.
    assert matched > 25 and matched - doubted < 5 and wrong < 3


@pytest.mark.sweep
def test_a_scan_of_another_place_does_not_move_the_path(drive):
    """Its pose is wrong, by its covariance; the other poses and the loops are right."""
    true, log, _ = drive
    odd = 30
    seen = np.where(np.arange(len(true)) == odd, odd + 17 - len(true), np.arange(len(true)))
    beams = jax.tree.map(lambda part: np.asarray(part)[seen], log.beams)
    solved = laser_slam.solve(log._replace(beams=beams), SETTINGS)
    position, _ = errors(solved.poses, true)
    error = solved.poses[1:] - true[1:]
    error[:, 2] = poses.wrapped(error[:, 2])
    nees = np.einsum("ki,kij,kj->k", error, np.linalg.inv(solved.cov[1:]), error)
    assert position[odd] > 0.5 and np.delete(position, odd).max() < 0.1
    assert nees.max() < 30 and np.delete(nees, odd - 1).max() < 10
    assert solved.doubted[odd]
    assert solved.counts["scans whose match is in doubt"] == solved.doubted.sum() < 4
    assert laser_slam.closure_score(solved, true).precision == 1.0


def test_matches_beyond_raw_odometry_that_stands_still_are_in_doubt(drive):
    _, log, _ = drive
    steps = poses.between(log.raw[:-1], log.raw[1:])
    steps[10:20] = 0.0
    raw = poses.chain(log.raw[0], steps)
    odometry = odometry_of(
        scans_of(log),
        steps_of(raw),
        raw[0],
    )
    assert odometry.doubted[11:21].sum() >= 4 and not odometry.doubted[:11].any()


def test_a_log_of_maximum_ranges_is_raw_odometry(drive):
    _, log, _ = drive
    short = laser_slam.ScanLog(*(part[:3] for part in (log.time, log.time, log.raw)), FAR)
    beams = log.beams._replace(
        range=np.full((3, 60), FAR), angle=log.beams.angle[:3], valid=log.beams.valid[:3]
    )
    solved = laser_slam.solve(short._replace(beams=beams), SETTINGS)
    np.testing.assert_allclose(solved.poses, log.raw[:3], atol=1e-9)
    assert solved.counts["keyframes"] == 1 and not np.any(solved.map.log_odds)


@refused(
    (
        lambda log: {"raw": log.raw[:3]},
        r"laser_slam\.solve: log\.raw: expected shape \(40, 3\), as of the scans",
    ),
    (
        lambda log: {"time": log.time[:3]},
        r"laser_slam\.solve: log\.time: expected shape \(40,\), as of the scans, got \(3,\)",
    ),
    (lambda log: {"max_range": 0.0}, "max_range"),
    (lambda log: {"beams": log.beams._replace(angle=log.beams.angle[:, :3])}, "angles"),
    (
        lambda log: {"beams": log.beams._replace(range=np.zeros((0, 3)))},
        r"laser_slam\.solve: log\.beams\.range: expected \(scans, beams\), at least one,",
    ),
    (
        lambda log: {"raw": log.raw * np.nan},
        r"laser_slam\.solve: log\.raw: the odometry of scan 0 is not finite",
    ),
    (
        lambda log: {"time": np.where(log.time == 3, np.nan, log.time)},
        "the time of scan 3 is not finite",
    ),
    (
        lambda log: {"beams": log.beams._replace(angle=log.beams.angle * np.nan)},
        "valid beam of scan 0",
    ),
)
def test_logs_that_are_none_are_refused(change):
    _, log = driven()
    laser_slam.solve(log._replace(**change(log)))


@refused(
    ({"beams": 0}, "beams"),
    ({"beams": 1.5}, "beams"),
    ({"sigma": -1.0}, "sigma"),
    ({"resolution": 0}, "resolution"),
    ({"jump": "x"}, "jump"),
    told="laser_slam.Settings.*",
)
def test_bad_settings_are_refused(change):
    laser_slam.Settings(**change)


def test_its_files(drive, tmp_path):
    _, log, solved = drive
    write_files(tmp_path, cli.slam.result_files(solved))
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {
        "trajectory.csv",
        "trajectory.tum",
        "graph.g2o",
        "loops.csv",
        "map.yaml",
        "map.pgm",
    }
    rows = np.loadtxt(tmp_path / "trajectory.tum")
    np.testing.assert_array_equal(rows[:, 0], log.time)
    np.testing.assert_allclose(rows[:, 1:3], solved.poses[:, :2], rtol=1e-8)
    assert len((tmp_path / "loops.csv").read_text().splitlines()) == 1 + len(solved.loops.outcome)
    assert cli.slam.result_summary(solved)["keyframes"] == len(solved.keyframe)


def carmen_lines(true, log):
    """ODOM and FLASER lines of the drive, one of each a scan."""
    lines = []
    rows = zip(true, log.raw, np.asarray(log.beams.range), strict=True)
    for k, (pose, raw, ranges) in enumerate(rows):
        told, driven = (" ".join(f"{value:.6f}" for value in each) for each in (pose, raw))
        lines.append(f"ODOM {driven} 0 0 0 {k} host {k}")
        ranges = " ".join(f"{value:.3f}" for value in ranges)
        lines.append(f"FLASER 60 {ranges} {told} {told} {k} host {k}")
    return lines


def test_the_command_scores_it_by_the_poses_in_the_file(drive, monkeypatch, tmp_path):
    """`jaxslam slam FILE`, with the result of above in place of a second one."""
    true, log, solved = drive
    monkeypatch.setattr(laser_slam, "solve", lambda log, settings, progress: solved)
    lines = carmen_lines(true, log)
    (tmp_path / "ring.log").write_text("\n".join(lines))
    out = tmp_path / "out"
    command = ["slam", str(tmp_path / "ring.log"), "--out", str(out)]
    assert cli.main([*command, "--figures", "svg"]) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["mean relation error to 10 m [m]"] < 0.1
    kept = laser_slam.closure_score(solved, true).kept
    assert summary["loops kept that agree with the poses in the file"] == kept
    names = {path.name for path in out.iterdir()}
    assert {"trajectory.tum", "graph.g2o", "map.pgm", "map_before.svg", "graph.svg"} <= names
    # Without odometry the poses in the file are all that is known of it, and score nothing.
    (tmp_path / "ring.log").write_text("\n".join(lines[1::2]))
    assert cli.main([*command, "--figures", "svg"]) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["score"].startswith("none: ") and "ATE, RMSE [m]" not in summary


def relation_text(relations, time):
    """Lines of a file of relations."""
    rows = zip(time[relations.first], time[relations.second], relations.pose.tolist(), strict=True)
    return "".join(f"{a:.5f} {b:.5f} {x} {y} 0 0 0 {yaw}\n" for a, b, (x, y, yaw) in rows)


def test_the_command_scores_it_by_relations(drive, monkeypatch, tmp_path, capsys):
    true, log, solved = drive
    time = 1e9 + 2.0 * log.time
    monkeypatch.setattr(laser_slam, "solve", lambda log, settings, progress: solved)
    lines = [
        " ".join([*line.split()[:-3], str(time[k // 2]), "host", "0"])
        for k, line in enumerate(carmen_lines(true, log))
    ]
    (tmp_path / "ring.log").write_text("\n".join(lines))
    parts = [metrics.relations(true, rows=rows) for rows in (1, 3, 30, 31)]
    relations = metrics.Relations(*map(np.concatenate, zip(*parts, strict=True)))
    far = int((relations.second - relations.first == 31).sum())
    text = relation_text(relations, time) + "5 6 0 0 0 0 0 0\n"
    (tmp_path / "ring.relations").write_text(text)
    out = tmp_path / "out"
    command = ["slam", str(tmp_path / "ring.log"), "--out", str(out)]
    options = ["--relations", str(tmp_path / "ring.relations"), "--figures", "svg"]
    assert cli.main([*command, *options]) == 0
    summary = json.loads((out / "summary.json").read_text())["relations"]
    count = len(relations.first)
    assert (summary["joined"], summary["not joined"], summary["tolerance [s]"]) == (count, 1, 1e-4)
    assert summary["all"]["relations"] == count and summary["over 60 s apart"]["relations"] == far
    for name, some in (("all", relations), ("over 60 s apart", metrics.relations(true, rows=31))):
        for path, at in (
            ("laser SLAM", solved.poses),
            ("laser odometry", solved.odometry),
            ("raw odometry", solved.raw),
        ):
            errors = metrics.relation_errors(some, at)
            expected = metrics.benchmark_figures(errors)
            for quantity, figures in summary[name][path].items():
                scores = figures["mean"], figures["std"]
                np.testing.assert_allclose(scores, expected[quantity], rtol=1e-6)
    assert summary["all"]["in the 95 % ellipse"] == count
    assert summary["all"]["without a covariance"] == 0
    printed = capsys.readouterr().out
    assert f"{count} of {count + 1} join the scans, within 0.0001 s" in printed
    assert f"all: {count} relations, 100.0 % in the 95 % ellipse" in printed
    assert "all, laser odometry" in printed and "over 60 s apart, laser SLAM" in printed


def test_relations_that_do_not_join_are_refused_before_the_work(
    drive, monkeypatch, tmp_path, capsys
):
    true, log, _ = drive
    monkeypatch.setattr(laser_slam, "solve", None)
    (tmp_path / "ring.log").write_text("\n".join(carmen_lines(true, log)))
    (tmp_path / "ring.relations").write_text("7.5 8.5 0 0 0 0 0 0\n50 60 0 0 0 0 0 0\n")
    out = tmp_path / "out"
    command = ["slam", str(tmp_path / "ring.log"), "--out", str(out)]
    assert cli.main([*command, "--relations", str(tmp_path / "ring.relations")]) == 2
    (message,) = capsys.readouterr().err.splitlines()
    assert "ring.relations: none of 2 relations, from 7.500000 s to 60.000000 s, " in message
    assert message.endswith("from 0.000000 s to 39.000000 s, within 0.0001 s at both ends")
    assert not out.exists()


# --- A log of another size is solved by the programs of the first ---------------------------------


@pytest.mark.sweep
def test_a_second_log_of_another_size_compiles_nothing():
    """Other scans, beams, walls and map; the first has a step of odometry that is not known, whose
    search a log may need or not."""
    true, log = driven()
    known = np.arange(len(true)) != 9
    first = laser_slam.solve(log._replace(odometry_known=known), SETTINGS)
    true, log = driven(scans=47, beams=90, seed=1, scale=1.6)
    with nothing_compiled():
        second = laser_slam.solve(log, SETTINGS)
    assert second.map.log_odds.shape != first.map.log_odds.shape
    assert len(second.graph.poses) != len(first.graph.poses)
    assert len(second.loops.outcome) != len(first.loops.outcome) > 0
    assert errors(second.poses, true)[0].max() < 0.15
