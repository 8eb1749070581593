"""`jaxslam fit`: the noises of a folder of tables, held parameters, a gate, and lines for its settings."""

import dataclasses
import json

import numpy as np
import pytest
from command import run_command

from jaxslam import datasets
from jaxslam.core.types import Info, Status
from jaxslam.datasets._noise_fit import autocorrelation

POINTS = {3: (3.0, 1.0), 5: (-1.0, 4.0), 8: (-3.0, -1.0)}
SETTINGS = """[motion]
noise = [0.05, 0.2, 0.0]  # by hand
[sensor]
noise = [0.3, 0.03]
[filter]
gate = 0.99999
update = "joint"
"""


def write(folder, steps=150):
    """A robot on a circle, velocity noise 0.1 m/s and 0.05 rad/s, range 0.1 m, bearing 0.03 rad."""
    rng = np.random.default_rng(5)
    pose, odometry, seen = (
        np.zeros(3),
        ["t [s],v [m/s],omega [rad/s]"],
        ["t [s],tag,range [m],bearing [rad]"],
    )
    for k in range(steps):
        t = 0.2 * k
        for tag, point in POINTS.items():
            dx, dy = np.array(point) - pose[:2]
            z = (
                np.hypot(dx, dy) + 0.1 * rng.normal(),
                np.arctan2(dy, dx) - pose[2] + 0.03 * rng.normal(),
            )
            far = 5.0 * (k == 70 and tag == 5)
            seen.append(f"{t:.2f},{tag},{z[0] + far:.5f},{z[1]:.5f}")
        v, omega = 0.5 + 0.1 * rng.normal(), 0.3 + 0.05 * rng.normal()
        odometry.append(f"{t:.2f},0.5,0.3")
        turn = 0.2 * omega
        pose = pose + [
            0.2 * v * np.cos(pose[2] + turn / 2),
            0.2 * v * np.sin(pose[2] + turn / 2),
            turn,
        ]
    (folder / "odometry.csv").write_text("\n".join(odometry) + "\n")
    (folder / "measurements.csv").write_text("\n".join(seen) + "\n")
    (folder / "dataset.toml").write_text('[motion]\nmodel = "velocity"\n' + SETTINGS[9:])
    return folder


def test_the_noises_of_a_folder_are_fitted_and_written(tmp_path, capsys):
    """Within 3.5 standard errors; an outlier at the gate is left out, a noise of 0 is held."""
    out = tmp_path / "out"
    assert run_command(["fit", str(write(tmp_path)), "--write", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "449 measurements used, others: 1 rejected" in printed
    assert "motion gamma [rad/s] = 0 was held" in printed
    assert "NOT" not in printed
    said = json.loads((out / "fit.json").read_text())
    truth = {
        "motion v [m/s]": 0.1,
        "motion omega [rad/s]": 0.05,
        "sensor range [m]": 0.1,
        "sensor bearing [rad]": 0.03,
    }
    assert said["parameters"].keys() == truth.keys()
    for name, value in truth.items():
        row = said["parameters"][name]
        z = np.log(row["after"] / value) / (row["standard error"] / row["after"])
        assert abs(z) < 3.5, (name, row)
        assert row["standard error"] < 0.4 * row["after"]
    assert abs(said["NIS / dof"][1] - 1) < 0.01 < abs(said["NIS / dof"][0] - 1)
    assert said["log-likelihood"][1] > said["log-likelihood"][0] + 20
    assert (
        abs(said["innovation autocorrelation"]) < 2 * said["innovation autocorrelation, 95 % band"]
    )
    assert said["converged"] and said["associations settled"]
    assert (out / "fit.toml").read_text() == (tmp_path / "fit.toml").read_text()
    fitted = datasets.table(tmp_path)
    assert fitted.motion.name == "velocity" and "[sensor] noise of fit.toml" in fitted.assumed
    after = {parameter.name: parameter.value for parameter in fitted.adjustable.parameters}[
        "sensor range [m]"
    ]
    np.testing.assert_allclose(after, said["parameters"]["sensor range [m]"]["after"], rtol=1e-3)
    assert (out / "fit.toml").read_text().startswith("[motion]\nnoise = [")
    comment = "  # v [m/s], omega [rad/s], gamma [rad/s]\n\n[sensor]\nnoise = ["
    assert comment in (out / "fit.toml").read_text()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--fix", "motion w"], "fit: fixed: expected some of motion v, motion omega"),
        (
            ["--fix", "motion v,motion omega,sensor range,sensor bearing"],
            "fit: fixed: expected a parameter",
        ),
    ],
)
def test_what_cannot_be_fitted_is_refused(tmp_path, refused, options, message):
    refused(["fit", write(tmp_path, 5), "--out", tmp_path / "out", *options], message)
    assert not (tmp_path / "out").exists()


def test_a_data_set_with_fixed_noises_or_other_errors_is_refused(tmp_path):
    data = datasets.table(write(tmp_path, 5))
    with pytest.raises(ValueError, match="fit: data: expected one with adjustable noises"):
        datasets.fit(dataclasses.replace(data, adjustable=None))
    with pytest.raises(ValueError, match="fit: calibrate: expected some of scale, wheels, he"):
        datasets.fit(data, calibrate=["axis"])


def test_innovations_that_last_are_correlated():
    """Of two landmarks in changing slots, coloured by w' = 0.8 w + noise, or white; by S they are scaled."""
    rng = np.random.default_rng(1)
    steps, slot = 4000, np.array([[0, 1], [1, 0]] * 2000)
    for factor in (0.8, 0.0):
        w = rng.normal(size=(steps, 2, 2))
        for k in range(1, steps):
            w[k] = factor * w[k - 1] + np.sqrt(1 - factor**2) * w[k]
        root = np.array([[2.0, 0.0], [1.0, 0.5]])
        nu = w[np.arange(steps)[:, None], slot] @ root.T
        nothing = np.zeros((steps, 2))
        cov = np.broadcast_to(root @ root.T, (steps, 2, 2, 2))
        info = Info(nothing, nothing, nu, cov, slot, np.full((steps, 2), Status.FUSED), nothing)
        found, band = autocorrelation(info)
        np.testing.assert_allclose(band, 1.96 / np.sqrt(4 * (steps - 1)), rtol=1e-4)
        assert abs(found - factor) < 2 * band
    empty = info._replace(status=0 * slot)
    assert np.isnan(autocorrelation(empty)).all()
