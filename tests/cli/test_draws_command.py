"""`jaxslam draws`: folders of tables, continued, refused, and of a user's own world."""

import json

from command import run_command

from jaxslam import datasets
from jaxslam._cli.campaigns import draws as command

MINE = """
import dataclasses
import jaxslam

def own(steps=3):
    return dataclasses.replace(jaxslam.scenarios.circle(steps), name="own")
"""


def test_draws_are_written_and_continued(tmp_path, capsys, refused):
    out = tmp_path / "draws"
    words = ["draws", "--scenario", "circle", "--steps", "3", "--out", out]
    assert run_command([*words, "--runs", "2", "--seed", "4"]) == 0
    said = capsys.readouterr().out
    assert f"wrote 2 runs of circle, 3 steps each, to {out}" in said and "README.md" in said
    assert sorted(path.name for path in out.iterdir()) == [
        "README.md",
        "draws.json",
        "runs",
        "truth",
    ]
    stored = json.loads((out / "draws.json").read_text())
    options = stored["options"]
    assert options.pop("command").startswith("jaxslam draws --scenario circle")
    assert options == {"scenario": "circle", "runs": 2, "steps": 3, "seed": 4}
    assert stored["dtype"] == "float64"
    assert datasets.table(out / "runs/0001").steps == 4  # with the start
    assert run_command([*words, "--runs", "3", "--seed", "4"]) == 0
    assert (out / "truth/0002/truth.csv").exists()
    refused(
        [*words, "--runs", "3"],
        "holds other draws: key is threefry2x32 0:4 there, threefry2x32 0:0 here",
    )


def test_an_interrupt_says_what_is_done(tmp_path, capsys, monkeypatch):
    def interrupted(*arguments, progress, **options):
        progress(7, 20)
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "write_draws", interrupted)
    assert run_command(["draws", "--runs", "20", "--out", tmp_path / "draws"]) == 130
    said = capsys.readouterr().err
    assert f"{tmp_path / 'draws'} has 7 of 20 runs; the same command goes on" in said


def test_draws_refuse_bad_options_and_worlds(tmp_path, refused):
    out = ["--out", tmp_path / "draws"]
    refused(["draws", "--scenario", "square_lines", *out], "expected landmarks that are points")
    refused(
        ["draws", "--scenario", "cirle", *out], "unknown scenario 'cirle' (did you mean circle?)"
    )
    refused(["draws", "--runs", "0", *out], "--runs: expected an integer >= 1, got 0")
    refused(["draws", "--seed", "-1", *out], "--seed: expected an integer from 0")
    refused(["draws", "--filters", "ekf", *out], "unrecognized arguments: --filters")
    assert not (tmp_path / "draws").exists()


def test_draws_of_a_world_in_a_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(MINE)
    assert run_command(["draws", "--scenario", "mine.py:own", "--runs", "1"]) == 0
    stored = json.loads((tmp_path / "draws/draws.json").read_text())
    assert (stored["scenario"], stored["options"]["scenario"]) == ("own", "mine.py:own")
