"""`jaxslam judge`: folders of estimates, programs that write them, and what is refused."""

import json
import sys

import jax
import numpy as np
import pytest
from cases import swept
from command import run_command
from estimates import write_estimates

from jaxslam import catalog, load, scenarios
from jaxslam._cli.campaigns import estimator_runs
from jaxslam.consistency import write_draws
from jaxslam.consistency.campaign import monte_carlo

STEPS, RUNS, KEY = 20, 3, jax.random.key(4)
OPTIONS = {"scenario": "circle", "steps": STEPS}
ONE = ["--devices", "1", "--figures", "png"]


@pytest.fixture(scope="module")
def world():
    return scenarios.circle(STEPS)


@pytest.fixture(scope="module")
def ekf(world):
    return catalog.FILTERS["ekf"](world)


@pytest.fixture(scope="module")
def draws(world, tmp_path_factory):
    folder = tmp_path_factory.mktemp("draws") / "draws"
    write_draws(world, RUNS, KEY, folder, options=OPTIONS)
    return folder


@pytest.fixture
def estimates(draws, tmp_path):
    """Estimates of a stranger that is the truth, moved."""
    return honest(draws, tmp_path / "mine")


def honest(draws, folder):
    for number in range(RUNS):
        rows = np.loadtxt(draws / f"truth/{number:04d}/truth.csv", delimiter=",", skiprows=1)
        rows[:, 1:] += 0.1 * np.random.default_rng(number).standard_normal((len(rows), 3))
        (folder / f"{number:04d}").mkdir(parents=True)
        write(folder, number, rows)
    return folder


def write(folder, number, rows, cov="0.01,0,0,0.01,0,0.01"):
    header = "t,x,y,theta,c_xx,c_xy,c_xt,c_yy,c_yt,c_tt\n"
    text = "".join(",".join(map("{:.17g}".format, row)) + f",{cov}\n" for row in rows)
    (folder / f"{number:04d}" / "trajectory.csv").write_text(header + text)


def read(folder, number):
    path = folder / f"{number:04d}" / "trajectory.csv"
    return np.loadtxt(path, delimiter=",", skiprows=1)[:, :4]


def judge(*words):
    return run_command(["judge", *words, *ONE])


def result(out):
    return json.loads((out / "consistency.json").read_text())


def test_our_ekf_by_files_has_the_numbers_of_the_campaign(
    world, ekf, draws, tmp_path, undrawn, capsys
):
    folder = write_estimates(tmp_path / "mine", world, ekf, RUNS, KEY)
    out = tmp_path / "out"
    assert judge(folder, "--draws", draws, "--filters", "ekf,ideal", "--out", out) == 0
    stored, printed = result(out), capsys.readouterr().out
    assert list(stored["filters"]) == ["mine", "ekf", "ideal"]
    assert (stored["runs"], stored["steps"], stored["scenario"]) == (RUNS, STEPS, "circle")
    assert stored["command"].startswith("jaxslam judge")
    mine, ours = stored["filters"]["mine"], stored["filters"]["ekf"]
    campaign = monte_carlo(world, {"ekf": ekf}, RUNS, KEY, devices=jax.devices()[:1])
    measures = campaign.filters["ekf"].measures
    of_steps = {"nees_own", "nees_landmarks"}  # the map in the files is the final one
    assert mine["measures"].keys() - of_steps == measures.keys() - of_steps
    for name in measures.keys() - of_steps:
        for column in (mine, ours):
            numbers = [column["measures"][name][end] for end in ("value", "low", "high")]
            expected = [x if np.isfinite(x) else None for x in measures[name]]
            for number, exact in zip(numbers, expected, strict=True):
                assert number == exact or abs(number - exact) <= 1e-9 * abs(exact), name
    assert mine["verdict"] == ours["verdict"] == campaign.filters["ekf"].verdict
    assert "mine: the landmark NEES is of its final maps" in printed
    assert {"report.html", "nees.png", "map.png"} <= {path.name for path in out.iterdir()}


def test_a_folder_of_other_blocks_is_left_alone(draws, estimates, tmp_path, undrawn, capsys):
    own = tmp_path / "out" / "blocks" / "notes.txt"
    own.parent.mkdir(parents=True)
    own.write_text("of the user")
    assert judge(estimates, "--draws", draws, "--out", tmp_path / "out") == 2
    assert "blocks is none of jaxslam judge" in capsys.readouterr().err
    assert own.read_text() == "of the user"


def assert_loaded_as_judged(out, again):
    """The folder of `jaxslam judge` is read back with every number, fault and note."""
    loaded = load(out)
    loaded.save(again, figures=())
    judged, saved = result(out), result(again)
    for stored in (judged, saved):
        del stored["command"], stored["seed"]
    assert saved == judged
    for name in ("consistency.csv", "measures.csv"):
        assert (again / name).read_bytes() == (out / name).read_bytes()


WORLDS = """
import dataclasses
import numpy as np
from jaxslam import motion, scenarios, sensors

circle = scenarios.circle(20)
whole = scenarios.cloister(20)
cloister = dataclasses.replace(whole, landmarks=np.asarray(whole.landmarks)[::4])
bearings = dataclasses.replace(
    cloister, filter_options={}, sensor=sensors.BearingOnly([[0.02**2]], free=([4.0], [[1.5**2]]))
)
ranges = dataclasses.replace(
    cloister, filter_options={}, sensor=sensors.RangeOnly([[0.1**2]], free=([0.0], [[0.5**2]]))
)
wheels = motion.Augmented(
    motion.Corrected(motion.Velocity(np.diag([0.1, 0.03, 0.0]) ** 2)), "scale", noise=(0.02, 0.01)
)
tyre = dataclasses.replace(
    circle,
    motion=wheels,
    noise_on="robot",
    pose=(0.0, 0.0, 0.0, 1.0, 1.0),
    pose_cov=np.diag([0.0, 0.0, 0.0, 0.05, 0.05]) ** 2,
)
"""


@pytest.mark.parametrize(
    "name", swept(["circle", "cloister", "bearings", "ranges", "tyre"], "ranges", "tyre")
)
def test_draws_that_our_command_runs_have_the_numbers_of_the_campaign(name, tmp_path, undrawn):
    (tmp_path / "worlds.py").write_text(WORLDS)
    scenario, folder = f"{tmp_path / 'worlds.py'}:{name}", tmp_path / "draws"
    of_world = ["--scenario", scenario, "--runs", RUNS, "--seed", "3"]
    assert run_command(["draws", *of_world, "--out", folder]) == 0
    for number in range(RUNS):
        run = folder / "runs" / f"{number:04d}"
        out = tmp_path / "mine" / run.name
        words = ["run", "--dataset", "table", run, "--innovations", "--out", out]
        assert run_command(words) == 0
    assert judge(tmp_path / "mine", "--draws", folder, "--out", tmp_path / "judged") == 0
    campaign = ["consistency", *of_world, "--filters", "ekf", *ONE, "--out", tmp_path / "campaign"]
    assert run_command(campaign) == 0
    mine, ours = result(tmp_path / "judged"), result(tmp_path / "campaign")
    assert mine["divergence_limit_m"] == pytest.approx(ours["divergence_limit_m"], rel=1e-9)
    (mine,), (ours,) = (stored["filters"].values() for stored in (mine, ours))
    assert (mine["verdict"], mine["rejected_by"]) == (ours["verdict"], ours["rejected_by"])
    absent = {"nees_own", "nees_landmarks", "unobservable", "rotation_information"}
    names = ours["measures"].keys() - absent
    assert names == mine["measures"].keys() - absent and {"nis_per_dof", "nees_pose"} <= names
    for measure in names:
        numbers, exact = (
            [np.nan if x is None else x for x in stored["measures"][measure].values()]
            for stored in (mine, ours)
        )
        np.testing.assert_allclose(numbers, exact, rtol=1e-9, atol=1e-12, err_msg=measure)


def test_times_are_matched_and_faults_are_named(draws, estimates, tmp_path, undrawn, capsys):
    rows = read(estimates, 0)
    rows[:, 0] += 4e-7  # within half a microsecond
    start = np.concatenate([[0.0], rows[0, 1:]])  # a line of odometry, which is no step
    write(estimates, 0, np.concatenate([start[None], rows]))
    rows = read(estimates, 1)
    rows[6, 0] += 1e-3
    write(estimates, 1, rows)
    (estimates / "0002" / "trajectory.csv").unlink()
    assert judge(estimates, "--draws", draws, "--out", tmp_path / "out") == 1
    (stored,) = result(tmp_path / "out")["filters"].values()
    assert stored["faults"] == {"has times that are not in the truth": [1], "missing": [2]}
    printed = " ".join(capsys.readouterr().out.split())
    assert "(run 1: trajectory.csv:8: t = 7.001)" in printed
    assert "1 missing (run 2: no trajectory.csv in it): averages of the 1 judged runs" in printed
    assert_loaded_as_judged(tmp_path / "out", tmp_path / "again")


@pytest.mark.parametrize(
    ("kept", "fault"),
    [(slice(0, 12), "ends early"), (np.r_[0:5, 6:20], "has no estimate at some steps")],
)
def test_rows_may_be_absent_where_they_are_not_judged(
    draws, estimates, tmp_path, undrawn, kept, fault
):
    write(estimates, 1, read(estimates, 1)[kept])
    options = ["--draws", draws, "--out", tmp_path / "out"]
    judge(estimates, *options)
    assert result(tmp_path / "out")["filters"]["mine"]["faults"] == {fault: [1]}
    if fault != "ends early":
        assert judge(estimates, *options, "--every", "4") == 0
        assert "faults" not in result(tmp_path / "out")["filters"]["mine"]
        assert result(tmp_path / "out")["steps"] == 5


def test_an_empty_file_is_one_run_that_is_not_judged(draws, estimates, tmp_path, undrawn, capsys):
    (estimates / "0001" / "trajectory.csv").write_text("")
    # a map without names has no measure, and no note
    (estimates / "0000" / "map.csv").write_text("landmark,x,y,c_xx,c_xy,c_yy\n,1,1,1,0,1\n")
    assert judge(estimates, "--draws", draws, "--out", tmp_path / "out") == 1
    assert result(tmp_path / "out")["filters"]["mine"]["faults"] == {"ends early": [1]}
    printed = " ".join(capsys.readouterr().out.split())
    assert "1 of 3 runs is not judged: 1 ends early (run 1: trajectory.csv is empty): " in printed
    assert "mine is not judged in some runs: ends early in run 1" in printed
    assert "NIS" not in printed.split("honest:")[0] and "autocorrelation" not in printed
    assert "landmark" not in printed


def test_numbers_that_are_not_finite_are_counted(draws, estimates, tmp_path, undrawn):
    path = estimates / "0001" / "trajectory.csv"
    lines = path.read_text().splitlines()
    lines[3] = lines[3].replace("0.01", "-nan(ind)" if sys.platform == "win32" else "NaN", 1)
    path.write_text("\n".join(lines) + "\n")
    assert judge(estimates, "--draws", draws, "--out", tmp_path / "out") == 1
    assert result(tmp_path / "out")["filters"]["mine"]["faults"] == {"not finite": [1]}


PROGRAM = """
import pathlib, shutil, sys, time
run, estimate, source = map(pathlib.Path, sys.argv[1:])
number = int(run.name)
assert (run / "odometry.csv").exists() and estimate.is_dir() and not list(estimate.iterdir())
with open(source / "calls", "a") as file:
    file.write(f"{number}\\n")
if (source / "fails").exists():
    if number == 0:
        print("the matrix is singular", file=sys.stderr)
        sys.exit(3)
    if number == 1:
        (estimate / "trajectory.csv").write_text("half of it")
        time.sleep(60)
shutil.copy(source / run.name / "trajectory.csv", estimate)
"""


def test_a_program_is_run_once_a_run_and_again_where_it_failed(
    draws, estimates, tmp_path, undrawn, capsys, refused
):
    script, folder = tmp_path / "filter.py", tmp_path / "theirs"
    script.write_text(PROGRAM)
    (estimates / "fails").touch()
    command = f"{sys.executable} {script} {{run}} {{estimate}} {estimates}"
    words = [folder, "--draws", draws, "--estimator", command, "--out", tmp_path / "out"]
    assert judge(*words, "--time-limit", "3") == 1
    (stored,) = result(tmp_path / "out")["filters"].values()
    assert stored["faults"] == {"exit status 3": [0], "over the time limit of 3 s": [1]}
    printed = capsys.readouterr().out
    assert "theirs, run 0, the first that failed:\nthe matrix is singular" in printed
    assert {path.name for path in folder.iterdir()} == {"0002"}
    (estimates / "fails").unlink()
    (estimates / "calls").unlink()
    assert judge(*words, "--processes", "1") == 0
    assert (estimates / "calls").read_text().split() == ["0", "1"]
    again = result(tmp_path / "out")
    assert "faults" not in again["filters"]["theirs"] and again["run_seconds"]["theirs"] > 0
    assert "wall time of a run [s]" in capsys.readouterr().out
    theirs = f"{sys.executable} {script} {{run}} {{estimate}} elsewhere"
    refused(
        ["judge", folder, "--draws", draws, "--estimator", theirs, "--out", tmp_path / "out"],
        "--estimator: ",
        "0000 holds an estimate of the command ",
        "choose another folder of estimates, or remove this one",
    )


@pytest.mark.parametrize("what", ["script", "log"])
def test_an_estimate_of_another_program_or_of_other_draws_is_not_judged(
    draws, estimates, tmp_path, undrawn, refused, world, what
):
    script, folder, of = tmp_path / "filter.py", tmp_path / "theirs", draws
    script.write_text(PROGRAM)
    command = f"{sys.executable} {script} {{run}} {{estimate}} {estimates}"
    options = ["--estimator", command, "--out", tmp_path / "out", *ONE]
    assert run_command(["judge", folder, "--draws", draws, *options]) == 0
    before = read(folder, 0)
    if what == "script":
        script.write_text(PROGRAM + "# a mended line")
        message = f"0000 holds an estimate of another {script}, which changed since: choose"
    else:
        of = tmp_path / "other"
        write_draws(world, RUNS, jax.random.key(9), of, options=OPTIONS)
        message = f"0000 holds an estimate of other draws than {of}: choose another folder"
        refused(  # without the program, too
            ["judge", folder, "--draws", of, "--out", tmp_path / "out", *ONE],
            f"judge.json: expected an estimate of {of}, got one of other draws",
        )
    refused(["judge", folder, "--draws", of, *options], message)
    np.testing.assert_array_equal(read(folder, 0), before)


def test_ctrl_c_says_what_is_finished(draws, estimates, tmp_path, monkeypatch, capsys):
    (tmp_path / "filter.py").write_text(PROGRAM)
    command = f"{sys.executable} {tmp_path / 'filter.py'} {{run}} {{estimate}} {estimates}"

    def stop(progress, finished, runs):
        raise KeyboardInterrupt

    monkeypatch.setattr(estimator_runs.Progress, "__call__", stop)
    words = [tmp_path / "theirs", "--draws", draws, "--estimator", command, "--processes", "1"]
    assert judge(*words, "--out", tmp_path / "out") == 130
    finished = len(list((tmp_path / "theirs").iterdir()))
    assert 1 <= finished < RUNS
    text = f"interrupted; {tmp_path / 'theirs'} has {finished} of 3 runs; the same command goes on"
    assert text in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_columns_are_compared_in_pairs(draws, estimates, tmp_path, undrawn, capsys):
    theirs = honest(draws, tmp_path / "theirs")
    for number in range(RUNS):  # of the same errors, with twice the standard deviations
        write(theirs, number, read(theirs, number), cov="0.04,0,0,0.04,0,0.04")
    options = ["--draws", draws, "--out", tmp_path / "out"]
    assert judge(estimates, theirs, *options, "--compare", "mine") == 0
    assert "3 runs in pairs" in capsys.readouterr().out
    pairs = result(tmp_path / "out")["pairs"]
    assert pairs["reference"] == "mine" and list(pairs["filters"]) == ["theirs"]
    nees = pairs["filters"]["theirs"]["measures"]["nees_pose"]
    gap = []
    for number in range(RUNS):
        true = np.loadtxt(draws / f"truth/{number:04d}/truth.csv", delimiter=",", skiprows=1)
        error = true[:, 1:] - read(estimates, number)[:, 1:]
        error[:, 2] = (error[:, 2] + np.pi) % (2 * np.pi) - np.pi
        gap.append(((error**2).sum(axis=1) * (1 / 0.04 - 1 / 0.01)).mean())
    assert nees["difference"]["value"] == pytest.approx(np.mean(gap), rel=1e-9)
    assert_loaded_as_judged(tmp_path / "out", tmp_path / "again")
    assert run_command(["consistency", "--resume", tmp_path / "out"]) == 2
    assert "holds the results of jaxslam judge: judge again" in capsys.readouterr().err
    with pytest.raises(ValueError, match="the runs, which Campaign"):
        load(tmp_path / "again")


def change_line(path, number, text):
    lines = path.read_text().splitlines()
    lines[number] = text
    path.write_text("\n".join(lines) + "\n")


NINE = ",".join("0" * 9)


@pytest.mark.parametrize(
    ("spoil", "options", "message"),
    [
        (
            None,
            ["--draws", "nowhere"],
            "nowhere: expected a folder of `jaxslam draws`: there is no",
        ),
        (None, ["--every", "3"], "--every: expected a divisor of the 20 steps, got 3"),
        (None, ["--runs", "9"], "--runs: expected at most 3"),
        (
            None,
            ["--compare", "min"],
            "--compare: expected one of ESTIMATES and --filters, mine, got",
        ),
        (None, ["--compare", "mine"], "--compare: expected two columns or more, got 1"),
        (None, ["--gap", "2"], "--gap: expected none without --estimate and --truth"),
        (None, ["--align", "best"], "--align: expected none without --estimate and --truth"),
        (None, ["--filters", "magic"], "--filters: unknown filter 'magic'"),
        (None, ["--time-limit", "0"], "--time-limit: expected a number above 0, got 0"),
        (None, ["--estimator", "prog {run}"], "expected a command with {run} and {estimate}"),
        (
            None,
            ["--estimator", "no-such-1 {run} {estimate}"],
            "no-such-1: there is no such program",
        ),
        (
            ("trajectory.csv", 4, f"x,{NINE}"),
            [],
            "trajectory.csv:5: column 1 (t): expected a number",
        ),
        (("trajectory.csv", 4, f"3,{NINE}"), [], "trajectory.csv:5: expected each time once, got"),
        (("trajectory.csv", 4, "4,0,0"), [], "trajectory.csv:5: expected 10 cells"),
        (("trajectory.csv", 0, "t,x,y,heading" + ",c" * 6), [], "trajectory.csv:1: "),
        (("map.csv", 1, "99,0,0,1,0,1"), [], "map.csv:2: column 1 (landmark): expected a landmark"),
        (("map.csv", 1, "1,0,0,1,0,1\n1,0,0,1,0,1"), [], "map.csv:3: expected a landmark once"),
        (
            ("innovations.csv", 0, "t,tag,a,b,c,d"),
            [],
            "innovations.csv:1: expected t, tag, 2 columns of",
        ),
        (("../0007/trajectory.csv", 0, "t"), [], "has runs 0000 to 0002 alone"),
    ],
)
def test_bad_input_is_one_line(draws, estimates, tmp_path, refused, spoil, options, message):
    if spoil is not None:
        name, line, text = spoil
        path = estimates / "0001" / name
        path.parent.mkdir(exist_ok=True)
        if not path.exists():
            header = "landmark,x,y,c_xx,c_xy,c_yy" if name == "map.csv" else "t"
            path.write_text(f"{header}\n0,0,0,1,0,1\n")
        change_line(path.resolve(), line, text)
    words = ["judge", estimates, "--draws", draws, "--out", tmp_path / "out", *ONE, *options]
    assert refused(words, message).count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_folders_and_draws_are_asked_for(draws, estimates, tmp_path, refused):
    refused(
        ["judge", "--draws", draws, *ONE], "ESTIMATES: expected a folder of estimates, got none"
    )
    refused(["judge", estimates, *ONE], "--draws: expected the folder of `jaxslam draws`, got none")
    refused(
        ["judge", tmp_path / "none", "--draws", draws, *ONE], "none is no folder: expected 0000/"
    )


def test_draws_of_another_scenario_are_noticed(draws, estimates, tmp_path, refused, world):
    other = tmp_path / "other"
    write_draws(world, 1, jax.random.key(9), other, options=OPTIONS)  # the path is the same
    (other / "draws.json").write_text((draws / "draws.json").read_text())
    refused(
        ["judge", estimates, "--draws", other, "--out", tmp_path / "out", *ONE],
        "0000/measurements.csv: expected what scenario circle draws here with the key of draws.json",
    )
