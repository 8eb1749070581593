"""`jaxslam run`: results of a data set on disk, checks of the covariance, and bad input."""

import csv
import json

import jax
import numpy as np
import pytest

from jaxslam import _cli as cli
from jaxslam import catalog, datasets, filters
from jaxslam._cli.recorded import filter_run
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
    run = ["run", "--dataset", "bonn", str(data), "--out", str(out)]
    assert cli.main(run) == 0
    assert jax.config.jax_enable_x64
    printed = capsys.readouterr().out
    assert "fused 4, initialized 2, rejected 0" in printed
    assert "at 3 of 3 checked steps" in printed
    assert {path.name for path in out.iterdir()} == {
        "trajectory.csv",
        "trajectory.tum",
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


def test_a_plan_of_python_runs_as_the_command_does(tmp_path, undrawn):
    folder, out = write_bonn(tmp_path / "bonn"), tmp_path / "out"
    assert cli.main(["run", "--dataset", "bonn", str(folder), "--out", str(out)]) == 0
    data = datasets.bonn(folder)
    ekf = filters.EkfSlam(data.motion, data.sensor, data.capacity, **data.filter_options)
    (run,) = cli.run.run_filters(cli.run.RunPlan(data, {"ekf": ekf})).values()
    summary = json.loads((out / "summary.json").read_text())
    same = {key: value for key, value in run.summary.items() if key != "seconds"}
    assert same == {key: summary[key] for key in same}


def test_innovations_are_written_on_demand(tmp_path, undrawn):
    data, out = write_bonn(tmp_path / "bonn"), tmp_path / "out"
    run = ["run", "--dataset", "bonn", str(data), "--innovations", "--out", str(out)]
    assert cli.main(run) == 0
    with (out / "innovations.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    summary = json.loads((out / "summary.json").read_text())
    assert len(rows) == summary["status"]["fused"] + summary["status"]["rejected"] == 4
    assert [row["tag"] for row in rows] == ["1", "2"] * 2
    upper = [name for name in rows[0] if name.startswith("s_")]
    squares = []
    for row in rows:
        nu = np.array([float(row[name]) for name in rows[0] if name.startswith("nu_")])
        a, b, c = (float(row[name]) for name in upper)
        squares.append(nu @ np.linalg.solve([[a, b], [b, c]], nu))
    nis = [float(row["nis"]) for row in rows]
    np.testing.assert_allclose(np.mean(nis) / 2, summary["NIS / dof"], rtol=1e-9)
    # Of the first of each scan: the others are given those before them, or after their correction.
    np.testing.assert_allclose(nis[::2], squares[::2], rtol=1e-9)
    likely = sum(float(row["log_likelihood"]) for row in rows)
    np.testing.assert_allclose(likely, summary["log-likelihood"], rtol=1e-9)


def test_run_writes_films_and_says_what_is_missing(tmp_path, capsys, films):
    data, out = write_bonn(tmp_path / "bonn"), tmp_path / "out"
    filters = ["--filters", "ekf,dead_reckoning"]
    run = ["run", "--dataset", "bonn", str(data), *filters, "--animate", "--out", str(out)]
    assert cli.main(run) == 0
    printed = capsys.readouterr().out
    assert "\nfilm: ffmpeg is not installed: GIF instead of MP4\n" in printed
    (likely,) = (line for line in printed.splitlines() if line.startswith("log-likelihood"))
    assert likely.endswith(" -")  # dead reckoning has no innovation
    for name in ("ekf", "dead_reckoning"):
        assert (out / f"film-{name}.gif").read_bytes().startswith(b"GIF")
        assert "data:image/png;base64," in (out / f"film-{name}.html").read_text()
    assert [film.title for film in films] == ["bonn: ekf", "bonn: dead_reckoning"]
    assert [films[0].caption(k).split(": ")[1] for k in range(3)] == [
        "0 fused, 2 new, 0 dropped",
        "2 fused, 0 new, 0 dropped",
        "2 fused, 0 new, 0 dropped",
    ]


@pytest.mark.parametrize(
    ("asked", "spoil", "message"),
    [
        (["moon"], "", "unknown dataset 'moon'"),
        (["rosbg"], "", "unknown dataset 'rosbg' (did you mean rosbag?)"),
        (["bonn"], "SENSOR 1 oops 0", "sensor_data.dat:10: "),
        (["victoria_park"], "", "victoria_park"),
        (["bonn", "--robot", "2"], "", "--robot: expected none, since this data set has one"),
    ],
)
def test_bad_input_exits_with_2_and_writes_nothing(tmp_path, refused, asked, spoil, message):
    data = write_bonn(tmp_path / "victoria_park")
    with (data / "sensor_data.dat").open("a") as file:
        file.write(spoil + "\n")
    out = tmp_path / "out"
    dataset, *options = asked
    refused(["run", "--dataset", dataset, data, *options, "--out", out], message)
    assert not out.exists()


def test_the_help_names_whole_filters_and_only_those_of_a_data_set(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    assert cli.main(["run", "--help"]) == 0
    words = capsys.readouterr().out.replace(",", " ").split()
    of_simulations = {"ideal", "batch_map"}
    assert {*catalog.ALL} - of_simulations <= {word.strip(";") for word in words}
    assert not of_simulations & {*words}


def test_a_covariance_is_judged_on_the_host():
    assert filter_run.is_positive_definite(np.diag([1.0, 1e-12]))
    assert not filter_run.is_positive_definite(np.diag([1.0, -1e-12]))
    assert not filter_run.is_positive_definite(np.array([[1.0, np.nan], [np.nan, 1.0]]))


def write_table(tmp_path):
    (tmp_path / "odometry.csv").write_text("t [s],v [m/s],omega [rad/s]\n0,1,0.1\n1,1,0\n")
    (tmp_path / "measurements.csv").write_text(
        "t [s],tag,range [m],bearing [rad]\n0,7,5,0.1\n1,7,4,0.1\n1,,3,-1\n"
    )
    (tmp_path / "truth.csv").write_text("t [s],x [m],y [m],theta [deg]\n0,0,0,0\n1,1,0,6\n")
    (tmp_path / "landmarks.csv").write_text("tag,x [m],y [m]\n7,5,0.5\n")
    (tmp_path / "dataset.toml").write_text("[filter]\ncapacity = 3\n")
    return tmp_path


def test_mapping_takes_the_true_path(tmp_path, capsys):
    """And leaves out, and counts, what was measured where the path is not known."""
    write_table(tmp_path)
    (tmp_path / "truth.csv").write_text("t [s],x [m],y [m],theta [deg]\n0,2,1,90\n0.9,1,0,6\n")
    out = tmp_path / "out"
    asked = ["run", "--dataset", "table", str(tmp_path), "--filters", "mapping", "--out", str(out)]
    assert cli.main(asked) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["measurements without a true pose, left out"] == 2
    assert summary["rows without a true pose"] == 1
    assert summary["status"]["born"] == 1
    rows = (out / "map.csv").read_text().splitlines()
    (point,) = csv.DictReader(rows)
    np.testing.assert_allclose(
        [float(point["x"]), float(point["y"])],
        [2 + 5 * np.cos(np.pi / 2 + 0.1), 1 + 5 * np.sin(np.pi / 2 + 0.1)],
        rtol=1e-5,
    )
    (tmp_path / "truth.csv").unlink()
    assert cli.main(asked) == 2
    assert "--filters: mapping needs the true path of the robot" in capsys.readouterr().err


def test_a_table_is_run_and_compared_with_its_truth(tmp_path, capsys):
    write_table(tmp_path)
    out = tmp_path / "out"
    assert cli.main(["run", "--dataset", "table", str(tmp_path), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "[sensor] noise = [0.1, 0.05] (range [m], bearing [rad])" in printed
    summary = json.loads((out / "summary.json").read_text())
    assert summary["ATE [m]"] < 0.2
    assert summary["rows without a true pose"] == 0 and "notes" not in summary
    # Of one landmark the joint NEES is its own.
    assert summary["map NEES of"] == "all landmarks, 2 dof"
    np.testing.assert_allclose(summary["map NEES"], summary["landmark NEES (2 is honest)"])
    assert 0 < summary["map NEES"] < 10
    assert summary["map NEES, 95 % of honest maps"] == [0.05064, 7.378]
    assert summary["map verdict"] in ("consistent", "optimistic")
    assert summary["status"]["born"] == 2
    # The landmark without a tag has no name.
    named = [line.split(",")[0] for line in (out / "map.csv").read_text().splitlines()]
    assert named == ["landmark", "7", ""]


def test_a_run_that_nothing_honest_explains_says_so():
    """Innovations of 5 σ, most of them rejected, or a truth that they contradict."""
    honest = {
        "status": {"fused": 90, "born": 4, "rejected": 6},
        "NIS / dof": 1.1,
        "pose NEES, median (2.37 is honest)": 3.0,
    }
    assert (
        filter_run.suspicions(honest) == filter_run.suspicions({"status": honest["status"]}) == []
    )
    for changed, begins in (
        ({"NIS / dof": 160.0}, "NIS / dof is 160, where 1 is honest: models or units are wrong"),
        ({"status": {"fused": 10, "rejected": 90}}, "the gate rejects 90 of 100: models or units"),
        ({"pose NEES, median (2.37 is honest)": 1e4}, "pose NEES, median is 1e+04, where 2.37 is"),
        ({"landmark NEES (2 is honest)": 1e4}, "landmark NEES is 1e+04, where 2 is honest, thoug"),
    ):
        (note,) = filter_run.suspicions(honest | changed)
        assert note.startswith(begins)


@pytest.mark.parametrize("filters", ["ekf", "ekf,dead_reckoning"])
def test_wrong_units_are_told_after_the_run(tmp_path, capsys, undrawn, filters):
    """Millimetres under [m]: a landmark that is seen again, and the truth does not know."""
    write_table(tmp_path)
    rows = "\n".join(f"{t},7,{5000 - 1000 * t},{0.4 * (t % 2)}" for t in range(4))
    (tmp_path / "measurements.csv").write_text(f"t [s],tag,range [m],bearing [rad]\n{rows}\n")
    odometry = "".join(f"{t},1,0.1\n" for t in range(4))
    (tmp_path / "odometry.csv").write_text(f"t [s],v [m/s],omega [rad/s]\n{odometry}")
    out = tmp_path / "out"
    asked = ["run", "--dataset", "table", str(tmp_path), "--filters", filters, "--out", str(out)]
    assert cli.main(asked) == 0
    told = "where 1 is honest: models or units are wrong (degrees under [rad]"
    assert capsys.readouterr().out.count(told) == 1
    summary = json.loads((out / "summary.json").read_text())
    assert told in str(summary.get("filters", {}).get("ekf", summary)["notes"])


def test_several_filters_side_by_side(tmp_path, capsys):
    data, out = write_bonn(tmp_path / "bonn"), tmp_path / "out"
    run = ["run", "--dataset", "bonn", str(data), "--filters", "dead_reckoning,ekf"]
    assert cli.main([*run, "--gate", "0.999", "--figures", "pdf,svg", "--out", str(out)]) == 0
    printed = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["dead_reckoning", "ekf"] in printed
    assert ["measurements", "unmatched", "6", "0"] in printed
    assert ["measurements", "fused", "0", "4"] in printed
    assert {path.name for path in out.iterdir()} == {
        "trajectory-dead_reckoning.csv",
        "trajectory-ekf.csv",
        "trajectory-dead_reckoning.tum",
        "trajectory-ekf.tum",
        "map-dead_reckoning.csv",
        "map-ekf.csv",
        "summary.json",
        "map.pdf",
        "map.svg",
    }
    assert (out / "map.pdf").read_bytes().startswith(b"%PDF")
    filters = json.loads((out / "summary.json").read_text())["filters"]
    assert filters["ekf"]["P positive definite"] == "at 3 of 3 checked steps"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--filters", "ekf,best"], "unknown filter 'best'; known: ekf"),
        (["--filters", "ekf,ekf"], "--filters: expected different names"),
        (["--filters", "ekf,"], "--filters: expected different names"),
        (["--filters", "ideal"], "--filters: ideal needs the true path of a simulation"),
        (["--filters", "batch_map"], "--filters: batch_map takes a whole log at once"),
        (["--filters", "seif"], "--filters: seif needs the tag of every measurement"),
        (["--gate", "9.2", "--associate", "joint"], "--gate: expected a probability"),
        (["--gate", "0.9"], "--gate: expected --associate, too"),
        (["--associate", "best"], "--associate: expected one of nearest"),
        (["--figures", "gif"], "--figures: expected formats of png, pdf, svg, got 'gif'"),
    ],
)
def test_filters_that_a_table_cannot_have_are_refused(tmp_path, refused, options, message):
    """A tag of it is unknown, so its default is an association."""
    write_table(tmp_path)
    run = ["run", "--dataset", "table", tmp_path, "--out", tmp_path / "out"]
    refused([*run, *options], message)
    assert not (tmp_path / "out").exists()


def test_a_known_map_must_be_in_the_frame_of_the_start(tmp_path, refused):
    data = write_bonn(tmp_path / "bonn")
    run = ["run", "--dataset", "bonn", data, "--filters", "localization"]
    refused(run, "--filters: localization needs a map, landmarks.csv, in the frame of the start")
