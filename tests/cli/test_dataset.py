"""`jaxslam run`: results of a data set on disk, checks of the covariance, and bad input."""

import json

import jax
import numpy as np
import pytest

from jaxslam import cli
from jaxslam.cli.dataset import positive_definite
from jaxslam.results import plot


def write_bonn(folder):
    folder.mkdir()
    (folder / "world.dat").write_text("1 2 0\n2 0 3\n")
    steps = ["ODOMETRY 0 0.1 0.1", "SENSOR 1 1.9 -0.1", "SENSOR 2 3.0 1.5"] * 3
    (folder / "sensor_data.dat").write_text("\n".join(steps) + "\n")
    return folder


def test_run_filters_a_data_set_and_writes_its_results(tmp_path, capsys, monkeypatch):
    out = tmp_path / "out"
    drawn = {}
    draw = plot.map_figure
    monkeypatch.setattr(
        plot, "map_figure", lambda *a, **more: drawn.update(more) or draw(*a, **more)
    )
    data = write_bonn(tmp_path / "bonn")
    assert cli.main(["run", "--dataset", "bonn", str(data), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "fused 4, born 2, rejected 0" in printed
    assert {path.name for path in out.iterdir()} == {
        "trajectory.csv",
        "map.csv",
        "summary.json",
        "map.png",
    }
    assert len((out / "trajectory.csv").read_text().splitlines()) == 4
    assert [line.split(",")[0] for line in (out / "map.csv").read_text().splitlines()] == [
        "landmark",
        "1",
        "2",
    ]
    summary = json.loads((out / "summary.json").read_text())
    assert summary["map RMSE after alignment [m]"] < 1.0
    assert summary["status"]["born"] == 2
    assert tuple(drawn["names"]) == (1, 2) and np.shape(drawn["true_points"]) == (2, 2)
    headings = 0.1 * np.arange(3)
    path = 0.1 * np.cumsum([np.cos(headings), np.sin(headings)], axis=1)
    np.testing.assert_allclose(drawn["dead_reckoning"][:, :2], path.T, atol=1e-12)


@pytest.mark.parametrize(
    ("dataset", "spoil", "message"),
    [
        ("moon", "", "unknown dataset 'moon'"),
        ("bonn", "SENSOR 1 oops 0", "sensor_data.dat:10: "),
        ("victoria_park", "", "victoria_park"),
    ],
)
def test_a_bad_data_set_exits_with_2_and_writes_nothing(tmp_path, refused, dataset, spoil, message):
    data = write_bonn(tmp_path / "victoria_park")
    with (data / "sensor_data.dat").open("a") as file:
        file.write(spoil + "\n")
    out = tmp_path / "out"
    refused(["run", "--dataset", dataset, data, "--out", out], message)
    assert not out.exists()


def test_a_covariance_is_judged_on_the_host():
    assert positive_definite(np.diag([1.0, 1e-12]))
    assert not positive_definite(np.diag([1.0, -1e-12]))
    assert not positive_definite(np.array([[1.0, np.nan], [np.nan, 1.0]]))


def test_the_command_says_in_how_many_steps_it_looked(tmp_path, capsys, refused):
    run = ["run", "--dataset", "bonn", str(write_bonn(tmp_path / "bonn")), "--out"]
    assert cli.main([*run, str(tmp_path / "a"), "--check-every", "2"]) == 0
    assert "at 2 of 2 checked steps" in capsys.readouterr().out
    message = "--check-every: expected at least 0"
    refused([*run, tmp_path / "b", "--check-every", "-1"], message)
    assert not (tmp_path / "b").exists()
    assert jax.config.jax_enable_x64
