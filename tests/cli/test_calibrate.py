"""`jaxslam fit --calibrate`: systematic errors of a simulated robot found in its log, written, and counted."""

import json
import re

import numpy as np
import pytest
from command import run_command

from jaxslam import datasets

TRUE = {
    "scale travel": 0.97,
    "scale turn": 1.05,
    "heading [rad]": -0.08,
    "range offset [m]": -0.05,
    "delay [s]": 0.06,
}
NOISE = {
    "motion v [m/s]": 0.05,
    "motion omega [rad/s]": 0.05,
    "sensor range [m]": 0.03,
    "sensor across [m]": 0.04,
}
SETTINGS = """[motion]
model = "velocity"
noise = [0.08, 0.08, 0.0]
[sensor]
noise = [0.05, 0.001]
across = 0.08
mount = [0.2, 0.0, 0.0]
max_range = 5.0
[filter]
start_noise = [0.01, 0.01, 0.01]
"""
POSTS = np.array([[3.0, 1.0], [0.0, 4.0], [-3.0, 2.0], [-2.0, -3.0], [2.0, -3.0], [5.0, -1.0]])
DT = 0.1


def write(folder, steps=1200, seed=3):
    """By NumPy alone; every sixth row has a scan, stamped later than it happened."""
    rng = np.random.default_rng(seed)
    pose = np.zeros(3)
    odometry = ["t [s],v [m/s],omega [rad/s]"]
    seen, truth = ["t [s],tag,range [m],bearing [rad]"], ["t [s],x [m],y [m],theta [rad]"]
    for k in range(steps):
        t = DT * k
        truth.append(f"{t:.3f},{pose[0]:.9f},{pose[1]:.9f},{pose[2]:.9f}")
        if k % 6 == 3:
            sensor = pose[:2] + 0.2 * np.array([np.cos(pose[2]), np.sin(pose[2])])
            for tag, gap in enumerate(POSTS - sensor):
                r = np.hypot(*gap)
                bearing = np.arctan2(gap[1], gap[0]) - pose[2]
                bearing += NOISE["sensor across [m]"] / np.hypot(r, 0.04) * rng.normal()
                bearing = np.angle(np.exp(1j * bearing))
                told = r + TRUE["range offset [m]"] + NOISE["sensor range [m]"] * rng.normal()
                told = min(told, 5.0)  # the laser writes its maximum
                seen.append(f"{t + TRUE['delay [s]']:.3f},{tag},{told:.9f},{bearing:.9f}")
        v, omega = 0.4 + 0.2 * np.sin(0.31 * t), 0.5 * np.sin(0.17 * t) + 0.15
        odometry.append(f"{t:.3f},{v:.9f},{omega:.9f}")
        travel = TRUE["scale travel"] * v + NOISE["motion v [m/s]"] * rng.normal()
        turn = (TRUE["scale turn"] * omega + NOISE["motion omega [rad/s]"] * rng.normal()) * DT
        along = pose[2] + TRUE["heading [rad]"] + turn / 2
        chord = travel * DT * np.sinc(turn / 2 / np.pi)
        pose = pose + [chord * np.cos(along), chord * np.sin(along), turn]
    for name, lines in (("odometry", odometry), ("measurements", seen), ("truth", truth)):
        (folder / f"{name}.csv").write_text("\n".join(lines) + "\n")
    (folder / "dataset.toml").write_text(SETTINGS)
    return folder


@pytest.mark.sweep
def test_the_errors_of_a_simulated_robot_are_found_and_their_uncertainty_is_counted(
    tmp_path, capsys
):
    """All parameters within χ² of their covariance, with p = 0.001; the pose NEES becomes honest."""
    folder, out = write(tmp_path), tmp_path / "out"
    assert run_command(["run", "--dataset", "table", str(folder), "--out", str(out)]) == 0
    before = json.loads((out / "summary.json").read_text())
    calibrated = ["--calibrate", "scale,heading,range,delay", "--fix", "range scale"]
    assert run_command(["fit", str(folder), *calibrated, "--write", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "range scale = 1 was held" in printed and "NOT" not in printed
    said = json.loads((out / "fit.json").read_text())
    assert said["converged"] and abs(said["NIS / dof"][1] - 1) < 0.01
    for name, value in NOISE.items():
        row = said["parameters"][name]
        assert abs(np.log(row["after"] / value)) < 4 * row["standard error"] / row["after"], name
    data = datasets.table(folder)
    models = data.adjustable
    names = [parameter.name for parameter in models.parameters]
    at = [names.index(name) for name in TRUE]
    error = models.values[at] - [*TRUE.values()]
    cov = models.cov[np.ix_(at, at)]
    assert error @ np.linalg.solve(cov, error) < 20.5  # χ² of 5 degrees of freedom
    neutral = np.array([1.0, 1.0, 0.0, 0.0, 0.0])
    assert (np.abs([*TRUE.values()] - neutral) > 2 * np.sqrt(np.diag(cov))).all()
    assert not models.cov[names.index("range scale")].any()  # held
    assert run_command(["run", "--dataset", "table", str(folder), "--out", str(out)]) == 0
    after = json.loads((out / "summary.json").read_text())
    assert after["uncertainty of constants"] == "added"
    assert after["dropped by the reader"]["measurements of the maximum range"] > 10
    nees = "pose NEES, median (2.37 is honest)"
    assert after[nees] < 6 < 15 < before[nees]
    # Without their uncertainty the covariance is smaller.
    constants, _, _ = (folder / "fit.toml").read_text().partition("\n[calibration]")
    (folder / "fit.toml").write_text(constants)
    assert run_command(["run", "--dataset", "table", str(folder), "--out", str(out)]) == 0
    alone = json.loads((out / "summary.json").read_text())
    assert "uncertainty of constants" not in alone
    np.testing.assert_allclose(alone["final pose"], after["final pose"], rtol=1e-9)
    assert alone[nees] > 1.02 * after[nees]


@pytest.mark.parametrize(
    ("section", "line", "message"),
    [
        (
            "motion",
            "scale = [1.0]",
            r"[motion] scale: expected 2 numbers (travel, turn), got [1.0]",
        ),
        ("motion", "scale = [0.0, 1.0]", "[motion] scale: expected a scale above 0"),
        ("motion", "axis = 0.1", "[motion] axis: expected one of model, noise"),
        ("sensor", "range = [-1, 0]", "[sensor] range: expected a scale above 0"),
        ("sensor", "delay = true", "[sensor] delay: expected 1 number ("),
        ("sensor", "max_range = -1", "[sensor] max_range: expected a number >= 0, got -1"),
        ("filter", "spacing = -3", "[filter] spacing: expected a number >= 0, got -3"),
        (
            "calibration",
            'parameters = ["size"]',
            "[calibration] parameters: expected some of motio",
        ),
        (
            "calibration",
            'parameters = ["scale turn"]\ncovariance = [[-1.0]]',
            "[calibration] covariance: expected a covariance",
        ),
        (
            "calibration",
            'parameters = ["scale turn"]',
            "[calibration] covariance: expected 1 rows of numbers",
        ),
    ],
)
def test_settings_that_are_none_are_refused(tmp_path, section, line, message):
    folder = write(tmp_path, 10)
    text = SETTINGS.replace("max_range = 5.0\n", "")
    head = f"[{section}]\n"
    text = text.replace(head, f"{head}{line}\n") if head in text else f"{text}{head}{line}\n"
    (folder / "dataset.toml").write_text(text)
    with pytest.raises(ValueError, match=re.escape(message)):
        datasets.table(folder)


def test_models_that_have_no_such_error_are_refused(tmp_path):
    folder = write(tmp_path, 10)
    text = SETTINGS.replace('"velocity"', '"unicycle"').replace("0.08, 0.0]", "0.08]")
    (folder / "dataset.toml").write_text(text.replace("across = 0.08", "axis = 0.1"))
    assert type(datasets.table(folder).sensor).__name__ == "Corrected"
    table = (folder / "measurements.csv").read_text().split("\n")
    bearings = [",".join((*row.split(",")[:2], row.split(",")[3])) for row in table if row]
    (folder / "measurements.csv").write_text("\n".join(bearings) + "\n")
    for key in ("axis = 0.1", "range = [1.0, 0.1]", "across = 0.1"):
        settings = text.replace("across = 0.08", key).replace("[0.05, 0.001]", "[0.05]")
        (folder / "dataset.toml").write_text(settings)
        with pytest.raises(
            ValueError, match=rf"\[sensor\] {key.split(' ')[0]}: expected one of .*, the keys of b"
        ):
            datasets.table(folder)


def test_measurements_closer_than_the_spacing_are_counted(tmp_path):
    folder = write(tmp_path, 40)
    (folder / "dataset.toml").write_text(SETTINGS + "spacing = 1.2\n")
    data = datasets.table(folder)
    scans = np.flatnonzero(np.asarray(data.log.scan.valid).any(axis=1))
    assert len(scans) == 4
    np.testing.assert_allclose(np.diff(np.asarray(data.time)[scans]), 1.2, atol=1e-9)
    far = data.dropped["measurements of the maximum range"]
    assert data.measurements + data.dropped["measurements closer than the spacing"] == 42 - far
    table = (folder / "measurements.csv").read_text().replace(",2,", ",,")
    (folder / "measurements.csv").write_text(table)
    with pytest.raises(ValueError, match=r"expected a tag, since a spacing is of one landmark"):
        datasets.table(folder)


def test_a_largest_range_that_repeats_is_noted(tmp_path):
    folder = write(tmp_path, 200)
    assert not [line for line in datasets.table(folder).assumed if "max_range" in line]
    (folder / "dataset.toml").write_text(SETTINGS.replace("max_range = 5.0\n", ""))
    (note,) = [line for line in datasets.table(folder).assumed if "max_range" in line]
    assert "ranges are 5 m, the largest" in note


@pytest.mark.sweep
def test_what_is_seen_only_together_is_named_and_not_written(tmp_path, capsys):
    folder = write(tmp_path, 120)
    command = ["fit", str(folder), "--calibrate", "heading,mount"]
    assert run_command([*command, "--write", "--out", str(tmp_path / "o")]) == 0
    printed = capsys.readouterr().out
    assert "heading [rad]: the log does not determine it (only together with mount" in printed
    assert "was not written into" in printed and not (folder / "fit.toml").exists()


def test_constants_that_are_certain_add_nothing(tmp_path):
    folder = write(tmp_path, 10)
    known = '[calibration]\nparameters = ["scale turn"]\ncovariance = [[0.0]]\n'
    (folder / "dataset.toml").write_text(SETTINGS + known)
    assert datasets.consider_constants(datasets.table(folder), lambda *models: None) is None
