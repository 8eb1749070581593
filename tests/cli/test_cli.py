"""The command: files, exit codes, and nothing left behind after bad input or an interrupt."""

import json
import re
import subprocess
import sys
import threading
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from worlds import three_parameters

from jaxslam import catalog, cli, report, store
from jaxslam.cli import asking, devices
from jaxslam.consistency import Measure
from jaxslam.monte_carlo import Interrupted

QUICK = ["consistency", "--scenario", "circle", "--steps", "8", "--runs", "3"]


def test_consistency_prints_a_table_and_writes_everything(tmp_path, capsys):
    out = tmp_path / "results"
    assert cli.main([*QUICK, "--filters", "ekf,ideal", "--seed", "4", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "verdict" in printed
    assert "published" not in printed  # of 2500 steps, and these are 8
    wrote, results, last = printed.splitlines()[-3:]
    assert wrote.startswith(f"wrote {out / 'report.html'}, ")
    assert re.fullmatch(
        r"results after .* s; once every program was there, the runs took .* s of them", results
    )
    assert re.fullmatch(
        r".* s in all, .* s of them to make \d+ programs: \d+ compiled, \d+ loaded from the cache",
        last,
    )
    names = {path.name for path in out.iterdir()}
    assert names == {"blocks", *cli.campaign.FILES}
    assert names == {
        "blocks",
        "report.html",
        "consistency.json",
        "consistency.csv",
        *(f"{n}.png" for n in ("nees", "bound", "cost", "coverage", "whiteness", "gained")),
        *(f"{n}.png" for n in ("errors", "map")),
    }
    found = json.loads((out / "consistency.json").read_text())
    assert (found["runs"], found["steps"], found["seed"]) == (3, 8, 4)
    assert list(found["filters"]) == ["ekf", "ideal"]
    assert found["command"].startswith("jaxslam consistency --scenario circle")


def test_on_a_terminal_a_line_tells_of_each_filter_as_soon_as_it_can(capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    with asking.Progress("circle") as progress:
        progress.glimpse("ekf", 64, Measure(5.814, 4.712, 7.214))
        progress.glimpse("one", 1, Measure(2.0, 0.0, np.inf))
        progress.glimpse("none", 64, None)
        progress(64, 100)
    shown = capsys.readouterr().err
    lines = [line.rpartition("\x1b[K")[2] for line in shown.split("\n")]
    assert lines[:2] == [
        "ekf: pose NEES 5.81 (4.71 to 7.21) over a first block of 64 runs; honest is 3",
        "one: pose NEES 2 over a first run; honest is 3",
    ]
    assert "64/100 runs" in shown
    assert "none" not in shown


def test_a_bar_tells_how_fast_it_goes_and_how_long_that_takes(capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    clock = iter([100.0, 130.0, 131.0, 132.0, 150.0])
    monkeypatch.setattr(asking.time, "perf_counter", lambda: next(clock))
    with asking.Progress("circle") as progress:
        for done in (64, 64, 128, 140):
            progress(done, 10_000)
    first, same, second, third = (
        line for line in capsys.readouterr().err.split("\x1b[K") if "/10,000" in line
    )
    assert first.endswith("64/10,000 runs, 30 s\r")
    assert same.endswith("64/10,000 runs, 31 s\r")  # no rate of nothing
    assert second.endswith("128/10,000 runs, 32 s, 32 a second, 5 min 8 s left\r")
    assert third.endswith("140/10,000 runs, 50 s, 3.8 a second, 43 min 15 s left\r")
    assert asking._duration(59.6) == "1 min 0 s"
    assert asking._duration(7322) == "2 h 2 min"


def test_the_version_is_told(capsys):
    assert cli.main(["--version"]) == 0
    assert f"(jax {jax.__version__}, Python 3." in capsys.readouterr().out


def test_a_first_result_does_not_wait_for_what_draws():
    found = subprocess.run(
        [sys.executable, "-c", "import sys, jaxslam.cli; print(*sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert {"matplotlib", "scipy.stats"}.isdisjoint(found.stdout.split())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--scenario", "moon"], "unknown scenario 'moon'"),
        (["--filters", "ekf,magic"], "unknown filter 'magic'"),
        (["--runs", "0"], "runs"),
        (["--runs", "many"], "invalid int"),
        (["--steps", "0"], "steps"),
        (["--block", "-1"], "block"),
        (["--seed", "-1"], "seed"),
        (["--dtype", "float16"], "invalid choice"),
        (["--devices", "0"], "at least 1 device"),
        (["--devices", "99"], "--devices: expected at most 4, as many as there are here (each a"),
        (["--filters", ""], "--filters: expected names of filters with commas between them"),
        (["--filters", "ekf,"], "or all, got 'ekf,'"),
        (["--cache", ""], "--cache: expected a folder, got ''"),
        (["--resume", " "], "--resume: expected a folder, got ' '"),
        (["--devices", "abacus"], "no device 'abacus' here; known: all, cpu"),
        (["--processes", "2"], "need --coordinator"),
        (["--coordinator", "here"], "expected --coordinator HOST:PORT"),
        (["--coordinator", "127.0.0.1:9", "--processes", "2"], "--process-id I"),
        (
            [
                "--coordinator",
                "127.0.0.1:9",
                "--processes",
                "2",
                "--process-id",
                "1",
                "--timeout",
                "1",
            ],
            "no coordinator at 127.0.0.1:9 within 1 s",
        ),
    ],
)
def test_bad_input_exits_with_2_and_writes_nothing(tmp_path, capsys, change, message):
    out = tmp_path / "results"
    assert cli.main([*QUICK, *change, "--out", str(out)]) == 2
    assert message in capsys.readouterr().err
    assert not out.exists()


def test_no_more_devices_are_made_than_there_are_cores(monkeypatch):
    told = {}
    monkeypatch.setattr(jax.config, "update", told.__setitem__)
    for asked, made in (("99", devices.cores()), ("1", 1), ("all", devices.cores())):
        devices.prepare(SimpleNamespace(devices=asked))
        assert told == {"jax_num_cpu_devices": made}


@pytest.mark.parametrize("asked", ["all", "fastslam1,fastslam2,particle_localization"])
def test_particles_are_named_as_any_filter_and_all_spans_them(tmp_path, monkeypatch, asked):
    seen = []

    def begun(scenario, filters, *arguments, **options):
        seen.extend(filters)
        raise Interrupted(None, 3)

    monkeypatch.setattr(cli.campaign, "monte_carlo", begun)
    assert cli.main([*QUICK, "--filters", asked, "--out", str(tmp_path / "out")]) == 130
    assert seen == (list(catalog.ALL) if asked == "all" else list(catalog.PARTICLES))


def test_a_filter_that_cannot_run_a_scenario_is_refused_by_name(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(cli.campaign, "monte_carlo", lambda *a, **k: pytest.fail("work was begun"))
    monkeypatch.setitem(cli.SCENARIOS, "signs", lambda steps: three_parameters())
    asked = ["consistency", "--scenario", "signs", "--steps", "5", "--filters", "ekf,fej"]
    assert cli.main([*asked, "--out", str(tmp_path)]) == 2
    message = capsys.readouterr().err
    assert "filter 'fej' cannot run scenario 'ring'" in message
    assert "range_bearing_signature" in message


def test_an_unwritable_folder_exits_with_2_before_any_work(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(cli.campaign, "monte_carlo", lambda *a, **k: pytest.fail("work was begun"))
    (tmp_path / "file").write_text("")
    out = tmp_path / "file" / "deeper" / "out"
    assert cli.main([*QUICK, "--out", str(out)]) == 2
    message = capsys.readouterr().err
    assert message == (
        f"jaxslam: results cannot be written to {out}: {tmp_path / 'file'} is not a folder\n"
    )

    def read_only(dir):
        raise PermissionError(13, "Permission denied", f"{dir}/tmpxyz")

    monkeypatch.setattr(report.tempfile, "TemporaryFile", read_only)
    out = tmp_path / "not" / "there"
    assert cli.main([*QUICK, "--out", str(out)]) == 2
    message = capsys.readouterr().err
    assert message == f"jaxslam: results cannot be written to {out}: Permission denied\n"


def test_an_interrupt_exits_with_130_and_writes_nothing(tmp_path, capsys, monkeypatch):
    def interrupted(*arguments, progress, **options):
        progress(1, 3)
        raise Interrupted(None, 3)

    monkeypatch.setattr(cli.campaign, "monte_carlo", interrupted)
    assert cli.main([*QUICK, "--out", str(tmp_path / "out")]) == 130
    assert "nothing was written" in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.*"))


def test_an_interrupted_command_leaves_no_thread_that_would_be_torn_down(tmp_path, monkeypatch):
    """At exit Python waits for threads, but for daemons, which crash in compiled code."""
    ended = threading.Event()

    def interrupted(*arguments, **options):
        raise Interrupted(None, 3)

    monkeypatch.setattr(cli.campaign, "monte_carlo", interrupted)
    monkeypatch.setattr(cli.campaign, "_prepare_drawing", ended.wait)
    before = set(threading.enumerate())
    try:
        assert cli.main([*QUICK, "--out", str(tmp_path / "out")]) == 130
        begun = set(threading.enumerate()) - before
        assert len(begun) == 1 and not any(thread.daemon for thread in begun)
    finally:
        ended.set()


def test_no_command_exits_with_2(capsys):
    assert cli.main([]) == 2
    assert "usage" in capsys.readouterr().err


def test_the_module_runs_as_a_program_in_float32(tmp_path):
    arguments = [
        *QUICK,
        "--steps",
        "1",  # of which there is no pose NEES
        "--filters",
        "dead_reckoning",
        "--dtype",
        "float32",
        "--out",
        str(tmp_path),
    ]
    done = subprocess.run(
        [sys.executable, "-m", "jaxslam", *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "In float32: the command's default is float64" in done.stdout
    assert json.loads((tmp_path / "consistency.json").read_text())["dtype"] == "float32"


def write_bonn(folder):
    folder.mkdir()
    (folder / "world.dat").write_text("1 2 0\n2 0 3\n")
    steps = ["ODOMETRY 0 0.1 0.1", "SENSOR 1 1.9 -0.1", "SENSOR 2 3.0 1.5"] * 3
    (folder / "sensor_data.dat").write_text("\n".join(steps) + "\n")
    return folder


def test_run_filters_a_data_set_and_writes_its_results(tmp_path, capsys):
    out = tmp_path / "out"
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


@pytest.mark.parametrize(
    ("dataset", "spoil", "message"),
    [
        ("moon", "", "unknown dataset 'moon'"),
        ("bonn", "SENSOR 1 oops 0", "sensor_data.dat:10: "),
        ("victoria_park", "", "victoria_park"),
    ],
)
def test_a_bad_data_set_exits_with_2_and_writes_nothing(tmp_path, capsys, dataset, spoil, message):
    data = write_bonn(tmp_path / "victoria_park")
    with (data / "sensor_data.dat").open("a") as file:
        file.write(spoil + "\n")
    out = tmp_path / "out"
    assert cli.main(["run", "--dataset", dataset, str(data), "--out", str(out)]) == 2
    assert message in capsys.readouterr().err
    assert not out.exists()


def kept(out):
    return {path.name for path in (out / "blocks").iterdir()}


def results(out):
    """What a campaign found, but for how long it took and what it was called."""
    found = json.loads((out / "consistency.json").read_text())
    return {
        k: v
        for k, v in found.items()
        if k not in ("seconds", "compile_seconds", "step_seconds", "command")
    }


def test_a_campaign_is_resumed_by_its_folder_alone(tmp_path, capsys):
    out = tmp_path / "out"
    again = ["consistency", "--resume", str(out), "--devices", "1"]
    asked = [
        *QUICK,
        "--filters",
        "ekf,dead_reckoning",
        "--no-bound",
        "--block",
        "1",
        "--devices",
        "1",
    ]
    assert cli.main([*asked, "--out", str(out)]) == 0
    whole, csv = results(out), (out / "consistency.csv").read_text()
    assert len(kept(out)) == 4

    # A finished one prints its result and stays as it is, files that were lost come back; a lost
    # block is computed again, a damaged one set aside.
    said = capsys.readouterr().out
    at = {path: path.stat().st_mtime_ns for path in out.iterdir()}
    text = (out / "consistency.json").read_text()
    assert cli.main(again) == 0
    table, _, rest = capsys.readouterr().out.partition("\n\n" + str(out))
    assert table and said.startswith(table)  # with the time of a step
    assert rest.startswith(" holds this campaign, finished: nothing was run and nothing written;")
    assert {path: path.stat().st_mtime_ns for path in out.iterdir()} == at
    (out / "map.png").unlink()
    assert cli.main(again) == 0
    assert (out / "map.png").exists()
    assert (out / "consistency.json").read_text() == text
    assert cli.main([*again, "--out", str(tmp_path / "other")]) == 2
    assert "expected no --out, got" in capsys.readouterr().err
    lost, damaged = sorted((out / "blocks").glob("*.npz"))[:2]
    lost.unlink()
    damaged.write_bytes(damaged.read_bytes()[:1000])
    (out / "consistency.json").unlink()
    assert cli.main(again) == 0
    assert f"{damaged.name}" in capsys.readouterr().err
    assert results(out) == whole
    assert (out / "consistency.csv").read_text() == csv
    assert f"{damaged.name}.bad" in kept(out)

    assert cli.main([*again, "--seed", "3", "--filters", "ekf"]) == 2
    message = capsys.readouterr().err
    assert "--seed is 0 there, 3 here; --filters is ekf,dead_reckoning there, ekf here" in message
    assert cli.main(["consistency", "--resume", str(tmp_path)]) == 2
    assert "no campaign to resume" in capsys.readouterr().err

    # More runs extend it, to what a campaign of as many gives; fewer than there are do not.
    assert cli.main([*again, "--runs", "5", "--block", "1", "--devices", "1"]) == 0
    extended = results(out)
    assert extended["runs"] == 5
    fresh = tmp_path / "fresh"
    assert cli.main([*asked, "--runs", "5", "--out", str(fresh)]) == 0
    assert extended == results(fresh)
    capsys.readouterr()
    assert cli.main([*again, "--runs", "4"]) == 2
    assert "has runs up to 5: expected at least as many, got 4" in capsys.readouterr().err
    assert store.resume(out / "blocks").runs == 5


def test_an_unfinished_campaign_is_not_overwritten_unasked(tmp_path, capsys, monkeypatch):
    out = tmp_path / "out"

    def stopped(*arguments, keep, **options):
        keep.save(0, {"x": np.zeros(2)}, 2)
        raise Interrupted(None, 3)

    monkeypatch.setattr(cli.campaign, "monte_carlo", stopped)
    monkeypatch.setattr(cli.campaign.shutil, "rmtree", lambda *a, **k: None)
    assert cli.main([*QUICK, "--out", str(out)]) == 130
    monkeypatch.undo()
    assert cli.main([*QUICK, "--out", str(out)]) == 2
    message = capsys.readouterr().err
    assert "2 of 3 runs done" in message
    assert "--resume" in message
    assert "--overwrite" in message
    monkeypatch.setattr(cli.campaign, "monte_carlo", lambda *a, **k: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        cli.main([*QUICK, "--out", str(out), "--overwrite"])
    assert store.resume(out / "blocks").spans() == []


def test_a_finished_campaign_is_not_overwritten_unasked(tmp_path, capsys, monkeypatch):
    out = tmp_path / "out"
    begun = []

    def finished(*arguments, keep, **options):
        if keep.spans() == []:
            keep.save(0, {"x": np.zeros(2)}, 3)
        begun.append(keep.spans())
        raise Interrupted(None, 3)

    monkeypatch.setattr(cli.campaign, "monte_carlo", finished)
    asked = [*QUICK, "--out", str(out)]
    assert cli.main(asked) == 130
    mine = out / "blocks" / "mine"
    mine.write_text("of this campaign")
    capsys.readouterr()
    for refused in (asked, [*asked, "--runs", "4", "--again"], [*asked, "--seed", "1", "--again"]):
        assert cli.main(refused) == 2
        message = capsys.readouterr().err
        assert f"{out} holds a finished campaign of 3 runs: --overwrite gives it up" in message
        assert f"--resume {out}" in message
        assert "--out" in message
    assert mine.exists() and len(begun) == 1
    for accepted in ("--again", "--overwrite"):
        mine.write_text("of this campaign")
        assert cli.main([*asked, accepted]) == 130
        assert not mine.exists()
    # Results without their blocks are results all the same.
    cli.campaign.shutil.rmtree(out / "blocks")
    (out / "consistency.json").write_text("{}")
    assert cli.main([*asked, "--again"]) == 2
    assert f"{out} holds the results of a campaign: --overwrite" in capsys.readouterr().err
    assert cli.main([*asked, "--overwrite"]) == 130
    assert cli.main([*asked, "--overwrite", "--resume", str(out)]) == 2
    assert "not allowed with" in capsys.readouterr().err


def test_a_campaign_begun_from_python_is_not_the_commands_to_resume(tmp_path, capsys):
    store.create(tmp_path / "blocks")
    assert cli.main(["consistency", "--resume", str(tmp_path)]) == 2
    assert "a campaign that no command began" in capsys.readouterr().err


def test_a_folder_of_something_else_is_left_alone(tmp_path, capsys):
    mine = tmp_path / "blocks" / "mine.txt"
    mine.parent.mkdir()
    mine.write_text("precious")
    assert cli.main([*QUICK, "--out", str(tmp_path)]) == 2
    assert "no campaign's" in capsys.readouterr().err
    assert mine.read_text() == "precious"
    (mine.parent / "manifest.json").write_text("{")
    assert cli.main([*QUICK, "--out", str(tmp_path), "--overwrite"]) == 2
    assert mine.exists()
