"""`jaxslam consistency`: campaigns interrupted, resumed, extended, and not overwritten unasked."""

import dataclasses
import json
import shutil
import subprocess
import sys
import time

import drawn
import numpy as np
import pytest

import jaxslam
from jaxslam import _cli as cli
from jaxslam import plot, store
from jaxslam.consistency.campaign import Interrupted
from jaxslam.results import _report as report

QUICK = ["consistency", "--scenario", "circle", "--steps", "8", "--runs", "3"]


def test_an_interrupt_exits_with_130_and_writes_nothing(tmp_path, capsys, monkeypatch):
    def interrupted(*arguments, **options):
        raise Interrupted(None, 3)

    monkeypatch.setattr(cli.consistency, "monte_carlo", interrupted)
    assert cli.main([*QUICK, "--out", str(tmp_path / "out")]) == 130
    assert "nothing was written" in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.*"))


def test_an_interrupt_shows_what_is_done_and_how_to_go_on(tmp_path, capsys, monkeypatch):
    done = dataclasses.replace(drawn.campaign(("ekf",)), published={})

    def interrupted(*arguments, **options):
        raise Interrupted(done, 300)

    monkeypatch.setattr(cli.consistency, "monte_carlo", interrupted)
    out = tmp_path / "out"
    assert cli.main([*QUICK, "--out", str(out)]) == 130
    told = capsys.readouterr()
    assert str(done) in told.out
    assert f"--resume {out} continues it" in told.err


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


def _without(out, copy, pattern):
    """A copy of a folder without some of its files."""
    shutil.copytree(out, copy)
    for path in copy.glob(pattern):
        path.unlink()
    return copy


def test_a_campaign_is_resumed_by_its_folder_alone(tmp_path, capsys, refused, undrawn):
    out = tmp_path / "out"
    again = ["consistency", "--resume", str(out), "--devices", "1"]
    asked = [*QUICK, "--filters", "dead_reckoning,localization", "--no-bound", "--block", "1"]
    asked += ["--devices", "1"]
    assert cli.main([*asked, "--out", str(out)]) == 0
    whole, csv = results(out), (out / "consistency.csv").read_text()
    assert len(kept(out)) == 4

    loaded = jaxslam.load(out)
    written = json.loads((out / "consistency.json").read_text())
    again_written = json.loads(report.as_json(loaded, written["command"], written["seed"]))
    assert again_written == written and report.as_csv(loaded) == csv
    assert np.isclose(plot.nees_figure(loaded, width=3.5).get_figwidth(), 3.5)
    with pytest.raises(ValueError, match="expected the results of a campaign: jaxslam consistency"):
        jaxslam.load(_without(out, tmp_path / "no results", "consistency.json"))
    with pytest.raises(ValueError, match="not finished: jaxslam consistency --resume"):
        jaxslam.load(_without(out, tmp_path / "a block less", "blocks/block-00000000*"))

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
    assert cli.main([*again, "--figures", "svg"]) == 0
    assert (out / "map.svg").exists()
    refused([*again, "--out", tmp_path / "other"], "expected no --out, got")
    lost, damaged = sorted((out / "blocks").glob("*.npz"))[:2]
    lost.unlink()
    damaged.write_bytes(damaged.read_bytes()[:1000])
    (out / "consistency.json").unlink()
    assert cli.main(again) == 0
    assert f"{damaged.name}" in capsys.readouterr().err
    assert results(out) == whole
    assert (out / "consistency.csv").read_text() == csv
    assert f"{damaged.name}.bad" in kept(out)

    # Filters are compared in the folder of a finished campaign; what is asked later replaces it.
    ends = "wrote ", " holds this campaign, finished: nothing was run and nothing written;"
    for compare, other, end in (
        (("--compare", "localization"), "dead_reckoning", ends[0]),
        ((), "dead_reckoning", ends[1]),
        (("--compare", "dead_reckoning"), "localization", ends[0]),
    ):
        assert cli.main([*again, *compare]) == 0
        said = capsys.readouterr().out
        assert end in said and "3 runs in pairs" in said
        assert list(json.loads((out / "consistency.json").read_text())["pairs"]["filters"]) == [
            other
        ]
    loaded = jaxslam.load(out)
    assert loaded.reference == "dead_reckoning" and str(loaded) in said
    pair = loaded.compare("localization", "dead_reckoning").measures["rmse_final"]
    np.testing.assert_allclose(pair.runs, 3)
    assert "in pairs" in (out / "report.html").read_text()
    near = "--compare: expected one of --filters, dead_reckoning, localization, got 'localisation'"
    refused([*again, "--compare", "localisation"], f"{near} (did you mean localization?)")

    difference = "--seed is 0 there, 3 here; --filters is dead_reckoning,localization there, ekf"
    parts = (difference, f"--resume: {out} holds another campaign")
    refused([*again, "--seed", "3", "--filters", "ekf"], *parts)
    refused(["consistency", "--resume", tmp_path], "no campaign to resume", "or begin a new one")

    # More runs extend it, to what a campaign of as many gives; fewer than there are do not.
    assert cli.main([*again, "--runs", "5", "--block", "1", "--devices", "1"]) == 0
    extended = results(out)
    assert extended["runs"] == 5
    fresh = tmp_path / "fresh"
    assert cli.main([*asked, "--runs", "5", "--out", str(fresh)]) == 0
    assert extended == results(fresh) and "pairs" not in extended
    parts = ("--runs: ", "is to have 5 runs: expected at least as many, got 4")
    refused([*again, "--runs", "4"], *parts)
    assert store.resume(out / "blocks").runs == 5


def test_a_campaign_is_continued_by_its_own_options_and_not_overwritten_unasked(
    tmp_path, monkeypatch, refused
):
    out = tmp_path / "out"
    begun = []

    def stopped(*arguments, keep, **options):
        begun.append(keep.spans())
        keep.claim({})
        keep.save(2 * len(begun), {"x": np.zeros(2)}, 2)
        raise Interrupted(None, 3)

    monkeypatch.setattr(cli.consistency, "monte_carlo", stopped)
    asked = [*QUICK, "--out", str(out)]
    assert [cli.main(asked), cli.main(asked)] == [130, 130]
    assert begun == [[], [(2, 2)]]
    mine = out / "blocks" / "mine"
    mine.write_text("of this campaign")
    others = f"--out: {out} holds another campaign: --seed is 0 there, 1 here: choose another"
    refused([*asked, "--seed", "1"], others, "--resume", "--overwrite")
    refused([*asked, "--runs", "2"], f"--runs: the campaign in {out} is to have 3 runs")
    assert mine.exists() and len(begun) == 2
    assert cli.main([*asked, "--seed", "1", "--overwrite"]) == 130
    assert not mine.exists() and begun[2] == []
    monkeypatch.setattr(cli.consistency, "monte_carlo", lambda *a, **k: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        cli.main([*asked, "--overwrite"])
    assert not out.exists()
    # Results without their blocks are results all the same.
    out.mkdir()
    (out / "consistency.json").write_text("{}")
    refused(asked, f"{out} holds the results of a campaign: add --overwrite")
    refused([*asked, "--overwrite", "--resume", out], "not allowed with")


def test_a_campaign_begun_from_python_is_not_the_commands_to_resume(tmp_path, refused):
    store.open(tmp_path / "blocks").claim({})
    refused(["consistency", "--resume", tmp_path], "a campaign that was begun from Python")


def test_the_folder_of_another_command_is_left_alone(tmp_path, refused):
    """Both write map.png."""
    (tmp_path / "summary.json").write_text('{"command": "jaxslam run --dataset table mine"}')
    refused([*QUICK, "--out", tmp_path], f"{tmp_path} holds the results of jaxslam run: choose")
    cli.common.check_out(tmp_path, "run")
    (tmp_path / "summary.json").unlink()
    (tmp_path / "consistency.json").write_text('{"command": ""}')  # saved from Python
    cli.common.check_out(tmp_path, "run")
    (tmp_path / "consistency.json").write_text('{"command": "jaxslam consistency"}')
    with pytest.raises(ValueError, match=r"--out: .* the results of jaxslam consistency"):
        cli.common.check_out(tmp_path, "run")


def test_a_folder_of_something_else_is_left_alone(tmp_path, refused):
    mine = tmp_path / "blocks" / "mine.txt"
    mine.parent.mkdir()
    mine.write_text("precious")
    refused([*QUICK, "--out", tmp_path], "no campaign's")
    assert mine.read_text() == "precious"
    (mine.parent / "manifest.json").write_text("{")
    refused([*QUICK, "--out", tmp_path, "--overwrite"])
    assert mine.exists()


@pytest.mark.sweep
def test_a_command_killed_while_it_writes_is_made_good_by_the_next(tmp_path):
    out, rng = tmp_path / "out", np.random.default_rng()
    command = [sys.executable, "-m", "jaxslam", *QUICK, "--filters", "dead_reckoning"]
    again = [sys.executable, "-m", "jaxslam", "consistency", "--resume", str(out)]
    quiet = {"stdout": subprocess.DEVNULL}
    subprocess.run([*command, "--out", str(out)], check=True, **quiet)
    expected, csv = results(out), (out / "consistency.csv").read_bytes()
    begin = time.perf_counter()
    subprocess.run(again, check=True, **quiet)
    seconds = time.perf_counter() - begin
    for _ in range(4):
        for name in ("consistency.json", "consistency.csv"):
            (out / name).unlink(missing_ok=True)
        process = subprocess.Popen(again, **quiet)
        try:  # in its last third, where it writes
            process.wait(seconds * rng.uniform(0.66, 1.0))
        except subprocess.TimeoutExpired:
            process.kill()
        process.wait()
    subprocess.run(again, check=True, **quiet)
    assert results(out) == expected
    assert (out / "consistency.csv").read_bytes() == csv
