"""`jaxslam consistency --like` and `jaxslam run --check`: twins of a log from the command line."""

import json

import drawn_logs
import numpy as np
import pytest
from command import run_command

SETTINGS = """
[motion]
model = "unicycle"
noise = [0.1, 0.05]
[sensor]
noise = [0.05, 0.02]
mount = [0.2, 0.0, 0.1]
"""


def write_log(folder, settings=SETTINGS, longer=1.0):
    """The log of a yard as the folder of tables."""
    data = drawn_logs.drawn(drawn_logs.yard(60), 3)
    folder.mkdir()
    row, place = np.nonzero(np.asarray(data.log.scan.valid))
    z = np.asarray(data.log.scan.z)[row, place] * [longer, 1.0]
    tags = np.asarray(data.log.scan.tag)[row, place]
    # A row of odometry leads to the next time.
    time = data.time - data.time[0] + drawn_logs.DT
    control = np.asarray(data.log.control)
    begins = np.concatenate([[0.0], time])
    odometry = np.column_stack([begins, np.vstack([control[:, :2], control[-1:, :2]])])
    seen = np.column_stack([time[row], tags, z])
    for name, header, table in (
        ("odometry.csv", "t [s],v [m/s],omega [rad/s]", odometry),
        ("measurements.csv", "t [s],tag,range [m],bearing [rad]", seen),
    ):
        np.savetxt(folder / name, table, fmt="%.9g", delimiter=",", header=header, comments="")
    (folder / "dataset.toml").write_text(settings)
    return folder


def test_a_campaign_of_twins_has_a_verdict_and_a_check(tmp_path, capsys, undrawn):
    folder, out = write_log(tmp_path / "yard"), tmp_path / "out"
    command = f"consistency --like {folder} --filters ekf,dead_reckoning --runs 24 --out {out}"
    assert run_command(command.split()) == 0
    printed = capsys.readouterr().out
    assert "twin of yard: 24 runs" in printed
    assert "On a robot like yours the EKF is " in printed
    assert "yard, ekf: " in printed and "of 24 twins" in printed
    assert "dead_reckoning: no check" in printed
    result = json.loads((out / "consistency.json").read_text())
    assert result["scenario"] == "twin of yard" and result["filters"]["ekf"]["counts"]["runs"] == 24
    (check,) = json.loads((out / "check.json").read_text()).values()
    assert check["twins"] == 24 and len(check["statistics"]) > 35
    assert {"report.html", "check.png", "nees.png"} <= {path.name for path in out.iterdir()}
    assert run_command(f"consistency --resume {out}".split()) == 0
    assert "nothing was run and nothing written" in capsys.readouterr().out


def test_a_run_is_checked(tmp_path, capsys, undrawn):
    """Ranges that are 15 % long are told from the log alone."""
    folder, out = write_log(tmp_path / "yard", longer=1.15), tmp_path / "out"
    command = f"run --dataset table {folder} --check --twins 24 --out {out}"
    assert run_command(command.split()) == 0
    printed = capsys.readouterr().out
    assert "distances are measured 1" in printed and "jaxslam fit --calibrate range" in printed
    check = json.loads((out / "check.json").read_text())["ekf"]
    assert check["findings"] and (out / "check.png").exists()


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ("consistency --like {} --scenario circle", "--scenario: expected none with --like"),
        ("consistency --dataset bonn", "--dataset: expected --like, too"),
        ("run --dataset table {} --check --twins 3", "--twins: expected an integer >= 20"),
        ("consistency --like {}x", "does not exist"),
    ],
)
def test_refused(tmp_path, refused, words, reason):
    folder = write_log(tmp_path / "yard")
    refused(f"{words.format(folder)} --out {tmp_path / 'out'}".split(), reason)


def test_default_noises_are_refused(tmp_path, refused):
    folder = write_log(tmp_path / "yard", settings='[motion]\nmodel = "unicycle"\n')
    words = f"consistency --like {folder} --out {tmp_path / 'out'}"
    refused(words.split(), "states no noise of [motion] and [sensor]", "jaxslam fit")
