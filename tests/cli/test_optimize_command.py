"""`jaxslam optimize`: its files and its table, the optimum, and bad input."""

import csv
import json
from types import SimpleNamespace

import broken
import numpy as np
import pytest
import small_graphs
from reference import graph as plain

from jaxslam import _cli as cli
from jaxslam import datasets, graphs
from jaxslam.results import plot


def small():
    """A noisy graph without a gauge; ids of points beside those of poses."""
    graph = small_graphs.drawn(noise=0.1, fixed_pose=np.zeros(8, bool))
    graph = graph._replace(point_id=np.arange(3, dtype=np.int32))
    return small_graphs.only(graph, "relative_pose", "relative_position")


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("graphs") / "small.g2o"
    datasets.write_graph(path, small())
    path.write_text("# by hand\n" + path.read_text())
    return path


def test_it_writes_the_optimum(file, tmp_path, capsys, monkeypatch, films):
    drawn = {}
    draw = plot.graph_figure

    def graph_figure(before, after, squared, **more):
        drawn.update(before=before, after=after, **more)
        return draw(before, after, squared, **more)

    monkeypatch.setattr(plot, "graph_figure", graph_figure)
    out = tmp_path / "out"
    assert (
        cli.main(
            ["optimize", str(file), "--start", "chordal", "--animate", "--certificate"]
            + ["--out", str(out)]
        )
        == 0
    )
    printed = capsys.readouterr().out
    fixed = small()._replace(fixed_pose=np.arange(8) == 0)
    poses, points, chi2 = plain.optimum(fixed)

    assert {path.name for path in out.iterdir()} == {
        *("summary.json", "poses.csv", "points.csv", "optimized.g2o", "graph.png"),
        *("film.gif", "film.html"),
    }
    summary = json.loads((out / "summary.json").read_text())
    np.testing.assert_allclose(summary["chi2"], chi2, rtol=1e-9)
    np.testing.assert_allclose(summary["chi2 of the file"], plain.chi2(fixed), rtol=1e-12)
    assert summary["degrees of freedom"] == 30 + 32 - 21 - 6
    assert summary["status"] == "converged" and summary["skipped lines"] == {"comments": 1}
    assert summary["chi2"] < summary["chi2 at the start"]
    worst = summary["worst residuals"]
    assert summary["certificate"] == "the chordal optimum next to it is global"
    assert summary["distance of the two optima [m]"] < 1.0
    assert len(worst) == 10 and worst[0]["between"][0].startswith("pose 1")

    rows = list(csv.DictReader((out / "poses.csv").read_text().splitlines()))
    assert [int(row["id"]) for row in rows] == list(range(10, 18))
    assert [int(row["fixed"]) for row in rows] == [1] + [0] * 7
    found = np.array([[float(r[k]) for k in ("x [m]", "y [m]", "theta [rad]")] for r in rows])
    np.testing.assert_allclose(found[:, :2], poses[:, :2], atol=1e-6)
    np.testing.assert_allclose(plain.wrap(found[:, 2] - poses[:, 2]), 0, atol=1e-6)
    again = datasets.read_graph(out / "optimized.g2o")
    np.testing.assert_array_equal(again.poses, found)
    np.testing.assert_allclose(again.points, points, atol=1e-6)
    np.testing.assert_array_equal(drawn["after"].poses, found)
    assert "converged: χ² = " in drawn["subtitles"][1]
    # The film's last iterate is the optimum.
    (film,) = films
    assert film.frames == 1 + summary["iterations"]
    assert film.caption(0) == f"start, χ² = {summary['chi2 at the start']:.6g}"
    assert film.caption(summary["iterations"]).endswith(f"χ² = {summary['chi2']:.6g}")

    for part in (
        "χ² = Σ eᵀ Ω e, without a factor ½; of relative poses e = Z⁻¹ ∘ (Xᵢ⁻¹ ∘ Xⱼ) as (x, y, θ)",
        "pose 10 is fixed, since the file fixes none",
        f"{summary['chi2']:.9g}",
        "comments 1",
        "to compile",
    ):
        assert part in printed


def test_a_plan_of_python_is_solved_as_the_command_solves_it(file):
    """By the program of the test above."""
    plan = cli.optimize.OptimizePlan(str(file), start="chordal")
    optimum = cli.optimize.solve(plan, cli.optimize.read_problem(plan))
    chi2 = plain.optimum(small()._replace(fixed_pose=np.arange(8) == 0))[2]
    assert optimum.converged and list(optimum.cost_by_start) == ["chordal"]
    np.testing.assert_allclose([optimum.chi2, optimum.cost], chi2, rtol=1e-9)


def test_a_film_shows_the_iterations_of_one_solution():
    with pytest.raises(ValueError, match="--animate: the kernel truncated is solved in rounds"):
        cli.optimize.OptimizePlan("graph.g2o", kernel="truncated", animate=True)


@pytest.mark.sweep
def test_a_file_of_toro_is_optimized_and_written_as_g2o(tmp_path, capsys, undrawn):
    graph = small_graphs.only(small(), "relative_pose")
    none = np.zeros(0, int)
    graph = graph._replace(points=np.zeros((0, 2)), point_id=none, fixed_point=none > 0)
    datasets.write_graph(tmp_path / "small.toro", graph)
    run = ["optimize", str(tmp_path / "small.toro"), "--out", str(tmp_path)]
    assert cli.main(run) == 0
    assert "optimized.g2o" in capsys.readouterr().out
    again = datasets.read_graph(tmp_path / "optimized.g2o")
    assert not again.fixed_pose.any()
    chi2 = json.loads((tmp_path / "summary.json").read_text())["chi2"]
    fixed = np.arange(8) == 0
    np.testing.assert_allclose(chi2, plain.optimum(graph._replace(fixed_pose=fixed))[2])


ORDERED = """VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 1 0 0
VERTEX_SE2 2 2 0 0
VERTEX_XY 5 1 1
EDGE_SE2 0 1 1 0 0 5 0 0 5 0 5
EDGE_SE2 1 2 1 0 0 5 0 0 5 0 5
EDGE_SE2_XY 0 5 1 1 5 0 5
EDGE_SE2 0 2 2.1 0 0 5 0 0 5 0 5
"""


@pytest.mark.sweep
@pytest.mark.parametrize("fixed", ["", "FIX 0\n"])
def test_gtsam_reads_what_is_written(tmp_path, undrawn, fixed):
    """Poses, relative poses and informations; FIX stands only where the file has it."""
    gtsam = broken.optional("gtsam")
    (tmp_path / "a.g2o").write_text(fixed + "".join(sorted(ORDERED.splitlines(True))))
    run = ["optimize", str(tmp_path / "a.g2o"), "--kernel", "huber", "--out", str(tmp_path / "o")]
    assert cli.main(run) == 0
    written = list((tmp_path / "o").glob("*.g2o"))
    assert len(written) == 1
    assert written[0].read_text().count("FIX") == bool(fixed)
    again = datasets.read_graph(written[0])
    factors, values = gtsam.readG2o(str(written[0]), False)
    table = again.tables["relative_pose"]
    assert factors.size() == len(table.z) == 3
    for row in range(3):
        factor = factors.at(row)
        assert list(factor.keys()) == again.pose_id[table.who[row]].tolist()
        z = factor.measured()
        np.testing.assert_allclose([z.x(), z.y(), z.theta()], table.z[row], atol=1e-12)
        information = factor.noiseModel().information()
        np.testing.assert_allclose(information, table.information[row], rtol=1e-12)
    for name, pose in zip(again.pose_id, again.poses, strict=True):
        at = values.atPose2(int(name))
        np.testing.assert_allclose([at.x(), at.y(), at.theta()], pose, atol=1e-12)


def test_an_optimum_without_a_proof_says_what_to_try(monkeypatch):
    proof = SimpleNamespace(certified=False, chi2=2.0, gap=1.0, position=0.1, heading=0.1)
    monkeypatch.setattr(graphs, "certificate", lambda graph: proof)
    summary = cli.optimize._certificate(small(), converged=True, plain=True)
    assert (
        summary["certificate"].startswith("not certified: ") and "--start" in summary["certificate"]
    )


def test_too_few_steps_are_no_success(file, tmp_path, capsys):
    """By the program of the test above: numbers are its arguments."""
    run = ["optimize", str(file), "--iterations", "1", "--out", str(tmp_path)]
    assert cli.main(run) == 1
    told = capsys.readouterr().err
    assert "exhausted" in told and "--start odometry, spanning_tree, chordal, robust" in told
    assert json.loads((tmp_path / "summary.json").read_text())["status"] == "exhausted"


@pytest.mark.sweep
def test_a_kernel_doubts_loops_and_points_but_not_the_path(file, tmp_path, monkeypatch):
    asked, solve = {}, graphs.optimize

    def optimize(graph, factors, **options):
        asked.update(options, tables=list(graph.tables))
        return solve(graph, factors, **options)

    monkeypatch.setattr(graphs, "optimize", optimize)
    run = ["optimize", str(file), "--kernel", "huber", "--certificate", "--out", str(tmp_path)]
    assert cli.main(run) == 0
    assert asked["tables"] == ["relative_pose", "relative_pose/loops", "relative_position"]
    assert list(asked["kernel"]) == ["relative_pose/loops", "relative_position"]
    summary = json.loads((tmp_path / "summary.json").read_text())
    costs = [summary[f"robust cost from {name}"] for name in ("given", "chordal", "robust")]
    assert summary["robust cost"] == min(costs)
    np.testing.assert_allclose(min(costs), summary["chi2 without the kernel"])  # no row is doubted
    loops, points = "relative_pose/loops", "relative_position"
    assert (
        summary["of weight above 1/2"] == {loops: 3, points: 16}
        and sum(summary["of weight 1/2 or less"].values()) == 0
    )
    assert summary["certificate"].startswith("none: not for a robust cost")
    assert len(datasets.read_graph(tmp_path / "optimized.g2o").tables["relative_pose"].z) == 10
    apart = graphs.with_loops_apart(small())
    assert apart.tables["relative_pose/loops"].who.tolist() == [[7, 0], [2, 6], [5, 1]]
    np.testing.assert_allclose(plain.chi2(datasets.read_graph(file)), small_chi2(apart), rtol=1e-14)


def small_chi2(graph):
    return sum(
        plain.chi2(graph._replace(tables={key.split("/")[0]: table}))
        for key, table in graph.tables.items()
    )


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("# by hand", "VERTEX_SE3 1", "small.g2o:1: unknown kind 'VERTEX_SE3'"),
        (
            "# by hand",
            "VERTEX_SE2 99 0 0 0",
            "disconnected: no measurement with information joins pose 99 to",
        ),
    ],
)
def test_a_bad_graph_exits_with_2_and_writes_nothing(file, tmp_path, refused, old, new, message):
    text = file.read_text()
    assert old in text
    spoiled = tmp_path / "small.g2o"
    spoiled.write_text(text.replace(old, new, 1))
    out = tmp_path / "out"
    refused(["optimize", spoiled, "--out", out], message)
    assert not out.exists()


@pytest.mark.parametrize(
    ("option", "message"),
    [
        (
            ["--start", "moon"],
            "unknown start 'moon'; known: given, odometry, spanning_tree, chordal, robust",
        ),
        (["--kernel", "moon"], "unknown kernel 'moon'; known: huber"),
        (["--error", "moon"], "unknown error 'moon'; known: pose, log"),
        (["--iterations", "0"], "iterations: expected an integer >= 1, got 0"),
    ],
)
def test_unknown_options_are_refused(file, tmp_path, refused, option, message):
    refused(["optimize", file, "--out", tmp_path / "out", *option], message)
    assert not (tmp_path / "out").exists()


def test_a_file_that_is_not_there(tmp_path, refused):
    refused(["optimize", tmp_path / "none.g2o"], "none.g2o: cannot be read")


def test_points_of_an_earlier_result_do_not_stay(file, tmp_path, undrawn):
    out = tmp_path / "out"
    posed = tmp_path / "posed.g2o"
    text = [line for line in file.read_text().splitlines() if "XY" not in line]
    posed.write_text("\n".join(text))
    for path, there in ((file, True), (posed, False)):
        assert cli.main(["optimize", str(path), "--out", str(out)]) == 0
        assert (out / "points.csv").exists() is there
