"""Folders of tables whose `dataset.toml` names states beside the pose."""

import numpy as np
import pytest
from command import run_command
from recordings import write

from jaxslam import datasets
from jaxslam.core.protocols import POSE

POINTS = {3: (3.0, 1.0), 5: (-1.0, 4.0), 8: (-3.0, -1.0)}
BIAS = 0.04
"""[rad/s] of the gyroscope in the log"""


def recorded(steps=100):
    """A robot on a circle whose gyroscope says BIAS too much."""
    rng = np.random.default_rng(7)
    pose = np.zeros(3)
    odometry = ["t [s],v [m/s],omega [rad/s]"]
    seen = ["t [s],tag,range [m],bearing [rad]"]
    for k in range(steps):
        for tag, point in POINTS.items():
            dx, dy = np.array(point) - pose[:2]
            z = np.hypot(dx, dy), np.arctan2(dy, dx) - pose[2]
            noisy = z + np.array([0.05, 0.01]) * rng.normal(size=2)
            seen.append(f"{0.2 * k:.2f},{tag},{noisy[0]:.5f},{noisy[1]:.5f}")
        v, omega = 0.5 + 0.02 * rng.normal(), 0.3 + 0.01 * rng.normal()
        odometry.append(f"{0.2 * k:.2f},0.5,{0.3 + BIAS}")
        half = 0.1 * omega
        chord = 0.2 * v * np.sinc(half / np.pi)
        pose = pose + [chord * np.cos(pose[2] + half), chord * np.sin(pose[2] + half), 2 * half]
    return {
        "odometry.csv": "\n".join(odometry) + "\n",
        "measurements.csv": "\n".join(seen) + "\n",
    }


BIASED = """
[motion]
model = "biased_odometry"
noise = [0.02, 0.01]
[state]
names = ["bias", "scale"]
start = [0.0, 1.0]
start_noise = [0.05, 0.02]
noise = [0.001, 0.0]
[sensor]
noise = [0.05, 0.01]
[filter]
update = "joint"
"""
SCALED = BIASED.replace('"biased_odometry"', '"velocity"').replace(
    "noise = [0.02, 0.01]", "noise = [0.02, 0.01, 0.0]"
)
SCALED = SCALED.replace('["bias", "scale"]', '["scale"]').replace("[0.0, 1.0]", "[1.0, 1.0]")


def test_the_bias_of_a_folder_is_a_state_with_a_start_and_a_walk(tmp_path):
    data = datasets.table(write(tmp_path, recorded() | {"dataset.toml": BIASED}))
    assert data.motion.state == (*POSE, "bias [rad/s]", "scale [1]")
    np.testing.assert_array_equal(data.pose, [0, 0, 0, 0, 1])
    np.testing.assert_allclose(np.diag(data.pose_cov), [0, 0, 0, 0.05**2, 0.02**2])
    # Noise of a line of odometry, 0.2 s, over a tenth of it; the walks are of a second.
    cov = np.asarray(data.motion.noise_cov(data.pose, np.array([0.5, 0.3, 0.02])))
    np.testing.assert_allclose(cov, np.diag([0.02**2 * 10, 0.01**2 * 10, 0.001**2 / 0.02, 0]))
    names = [parameter.name for parameter in data.adjustable.parameters]
    assert {"state bias [rad/s]", "state scale [1]"} <= set(names)
    assert "scale turn" in names  # a constant, of `Corrected`


def test_run_writes_the_states_at_the_end_of_the_trajectory(tmp_path):
    folder, out = write(tmp_path, recorded() | {"dataset.toml": BIASED}), tmp_path / "out"
    assert run_command(["run", "--dataset", "table", str(folder), "--out", str(out)]) == 0
    table = np.genfromtxt(out / "trajectory.csv", delimiter=",", names=True)
    beside = ("bias", "scale", "c_bias_bias", "c_bias_scale", "c_scale_scale")
    assert table.dtype.names[-5:] == beside
    sigma = np.sqrt(table["c_bias_bias"][-1])
    assert sigma < 0.005
    assert abs(table["bias"][-1] - BIAS) < 4 * sigma
    with_fastslam = ["run", "--dataset", "table", str(folder), "--filters", "fastslam2"]
    assert run_command([*with_fastslam, "--out", str(tmp_path / "no")]) == 2


def test_errors_of_the_odometry_are_states_too(tmp_path):
    data = datasets.table(write(tmp_path, recorded() | {"dataset.toml": SCALED}))
    assert data.motion.state == (*POSE, "scale 1 [1]", "scale 2 [1]")
    names = [parameter.name for parameter in data.adjustable.parameters]
    assert "state scale travel" in names and "scale travel" not in names
    out = tmp_path / "out"
    assert run_command(["run", "--dataset", "table", str(tmp_path), "--out", str(out)]) == 0
    table = np.genfromtxt(out / "trajectory.csv", delimiter=",", names=True)
    # On a circle a bias is a scale of the turn.
    assert abs(table["scale_2"][-1] - 0.3 / (0.3 + BIAS)) < 0.02


COASTING = """
[motion]
model = "constant_velocity"
[state]
start = [0.5, 0.3]
start_noise = [0.3, 0.2]
noise = [0.05, 0.02]
[sensor]
noise = [0.05, 0.01]
"""


def test_a_folder_without_odometry_has_times_and_velocities(tmp_path):
    """`odometry.csv` with times alone is a clock; the run is that of the same log in Python."""
    tables = recorded()
    clock = [line.split(",")[0] for line in tables["odometry.csv"].splitlines()]
    tables["odometry.csv"] = "\n".join(clock) + "\n"
    folder = write(tmp_path, tables | {"dataset.toml": COASTING})
    data = datasets.table(folder)
    assert data.motion.state == (*POSE, "v [m/s]", "omega [rad/s]")
    np.testing.assert_allclose(data.log.control, [[0.0]] + [[0.2]] * 99)
    cov = np.asarray(data.motion.noise_cov(data.pose, np.array([0.2])))
    np.testing.assert_allclose(cov, np.diag([0.05, 0.02]) ** 2 / 0.2)
    names = [parameter.name for parameter in data.adjustable.parameters]
    assert names[:2] == ["state v [m/s]", "state omega [rad/s]"] and data.default_noises == ()
    out = tmp_path / "out"
    assert run_command(["run", "--dataset", "table", str(folder), "--out", str(out)]) == 0
    table = np.genfromtxt(out / "trajectory.csv", delimiter=",", names=True)
    for name, true in (("v", 0.5), ("omega", 0.3)):
        assert abs(table[name][-30:].mean() - true) < 0.03
    (folder / "dataset.toml").write_text(COASTING.replace("[state]", "noise = [0.1]\n[state]"))
    with pytest.raises(ValueError, match=r"\[motion\] noise: expected none: constant_velocity has"):
        datasets.table(folder)


@pytest.mark.sweep
def test_fit_finds_the_walk_of_a_state(tmp_path, capsys):
    folder = write(tmp_path, recorded() | {"dataset.toml": BIASED})
    arguments = ["fit", str(folder), "--fix", "motion v,motion omega,sensor range,sensor bearing"]
    assert run_command([*arguments, "--write", "--out", str(tmp_path / "out")]) == 0
    assert "state bias" in capsys.readouterr().out
    fitted = datasets.table(folder)
    (walk,) = [p.value for p in fitted.adjustable.parameters if p.name == "state bias [rad/s]"]
    assert 0 <= walk < 0.02


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ('["bias", "scale"]', '["bias"]', r"\[state\] names: expected bias, scale, the states of"),
        ("start = [0.0, 1.0]\n", "", r"\[state\] start: expected 2 numbers \(bias \[rad/s\]"),
        ("start_noise = [0.05, 0.02]", "start_noise = [0.05, -1]", "start_noise: expected numbers"),
        (
            '"biased_odometry"',
            '"odometry"',
            r"\[state\] names: expected some of scale, wheels, heading|expected",
        ),
        ('"biased_odometry"', '"constant_velocity"', "names: expected some of v, omega, got"),
    ],
)
def test_settings_that_do_not_fit_are_refused(tmp_path, old, new, reason):
    settings = BIASED.replace(old, new)
    assert settings != BIASED
    with pytest.raises(ValueError, match=reason) as caught:
        datasets.table(write(tmp_path, recorded(5) | {"dataset.toml": settings}))
    assert "\n" not in str(caught.value)
