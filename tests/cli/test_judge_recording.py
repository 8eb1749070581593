"""The command that judges a recorded robot: what it prints and writes, what it refuses."""

import argparse
import csv
import json

import bags
import numpy as np
import pytest
from bags import stamped_pose
from cases import refused
from PIL import Image

from jaxslam._cli.common import add_figures, add_out
from jaxslam._cli.recorded import judge_recording
from jaxslam.consistency import judge_recording as judge
from jaxslam.datasets import recorded_path
from jaxslam.math import numpy_poses as poses


def parsed(*words):
    parser = argparse.ArgumentParser()
    judge_recording.add_arguments(parser)
    add_figures(parser, ("png",))
    add_out(parser)
    options = parser.parse_args([str(word) for word in words])
    options.out = __import__("pathlib").Path(options.out)
    return options


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """A robot with white errors of 10 cm and 0.05 rad, claimed with half of it."""
    rng = np.random.default_rng(0)
    count = 300
    speed = 0.5 + 0.3 * np.sin(0.2 * np.arange(count - 1))
    path = poses.chain(np.zeros(3), np.column_stack([0.1 * speed, 0 * speed, 0.02 * speed]))
    deviations = np.array([0.1, 0.1, 0.05]) * (1 + 0.1 * np.sin(np.arange(count)))[:, None]
    pose = path + deviations * rng.standard_normal((count, 3))
    messages = []
    for k in range(count):
        stamp = 1_700_000_000 * bags.SECOND + k * bags.SECOND // 10
        cov = np.diag(deviations[k] / 2) ** 2
        kind = "PoseWithCovarianceStamped"
        messages.append(stamped_pose(stamp, pose[k], "/amcl_pose", cov, kind=kind))
        messages.append(stamped_pose(stamp, path[k], "/mocap/pose", frame="world"))
    return bags.write(tmp_path_factory.mktemp("bag"), messages, "mcap")


def test_what_is_printed_and_written(bag, tmp_path, capsys):
    estimate, truth = f"{bag}:/amcl_pose", f"{bag}:/mocap/pose"
    options = parsed("--estimate", estimate, "--truth", truth, "--out", tmp_path / "out")
    assert judge_recording.run(options, "jaxslam judge …") == 0
    printed = capsys.readouterr().out
    read = recorded_path(estimate)
    reference = recorded_path(truth)
    scores = judge((read.time, read.pose, read.cov), (reference.time, reference.pose))
    assert str(scores) in printed
    assert "in the frame 'map', the truth in 'world'" in printed
    files = {path.name for path in (tmp_path / "out").iterdir()}
    assert files == {"summary.json", "errors.csv", "errors.png"}
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["verdict"] == "optimistic"
    assert summary["blocks"]["pose"]["nees"] == list(scores.blocks["pose"].nees)
    assert summary["factors of sigma"]["along"][0] == pytest.approx(2, rel=0.2)
    with (tmp_path / "out" / "errors.csv").open() as file:
        header, *rows = csv.reader(file)
    assert header[:4] == ["t [s]", "along [m]", "across [m]", "heading [rad]"]
    np.testing.assert_allclose(np.array(rows, float)[:, 1:4], scores.errors.error, rtol=1e-8)
    with Image.open(tmp_path / "out" / "errors.png") as image:
        assert image.width > 1000


def test_errors_alone_are_drawn_without_a_covariance(bag, tmp_path):
    words = ["--estimate", f"{bag}:/mocap/pose", "--truth", f"{bag}:/mocap/pose"]
    assert judge_recording.run(parsed(*words, "--out", tmp_path / "out")) == 0
    with Image.open(tmp_path / "out" / "errors.png") as picture:
        assert picture.size[0] > 500
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["verdict"] == "incomplete"


def test_options_of_draws_are_refused_beside_a_recording(tmp_path, refused):
    (tmp_path / "a.tum").write_text("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n")
    words = ["judge", "--estimate", tmp_path / "a.tum", "--truth", tmp_path / "a.tum"]
    for option in (["--every", "2"], ["--filters", "ekf"], ["--bound"], ["--runs", "3"]):
        refused(
            [*words, *option, "--out", tmp_path / "out"],
            f"{option[0]}: expected none beside --estimate and --truth",
        )


def test_options_reach_the_scores(bag, tmp_path, capsys):
    words = ["--estimate", f"{bag}:/amcl_pose", "--truth", f"{bag}:/mocap/pose"]
    options = parsed(
        *words,
        "--align",
        "best",
        "--covariance-frame",
        "body",
        "--out",
        tmp_path,
        "--figures",
        "png",
    )
    judge_recording.run(options)
    printed = capsys.readouterr().out
    assert "best rigid motion" in printed
    assert "in the frame" not in printed


@refused(
    (["--truth", "a.csv"], "--estimate: expected the poses of a recorded robot"),
    (["--estimate", "a.csv"], "--truth: expected the poses of a recorded robot"),
    (["--estimate", "BAG:/none", "--truth", "BAG:/mocap/pose"], "BAG: expected BAG:/topic"),
    (
        ["--estimate", "BAG:/amcl_pose", "--truth", "BAG:/mocap/pose", "--gap", "0"],
        "--gap: expected",
    ),
    (
        ["--estimate", "BAG:/amcl_pose", "--truth", "OLD"],
        "BAG:/amcl_pose by OLD: judge_recording: expected at least two",
    ),
)
def test_bad_input_writes_nothing(words, bag, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "BAG").symlink_to(bag)
    (tmp_path / "OLD").write_text("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n")
    try:
        judge_recording.run(parsed(*words, "--out", "out"))
    finally:
        assert not (tmp_path / "out").exists()
