"""The command: files, exit codes, and nothing left behind after bad input or an interrupt."""

import json
import subprocess
import sys

import pytest

from jaxslam import cli

QUICK = ["consistency", "--scenario", "circle", "--steps", "8", "--runs", "3"]


def test_consistency_prints_a_table_and_writes_everything(tmp_path, capsys):
    out = tmp_path / "results"
    assert cli.main([*QUICK, "--filters", "ekf,ideal", "--seed", "4", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "verdict" in printed
    assert "published" in printed
    names = {path.name for path in out.iterdir()}
    assert names == {"consistency.json", "consistency.csv", "nees.png", "errors.png", "map.png"}
    found = json.loads((out / "consistency.json").read_text())
    assert (found["runs"], found["steps"], found["seed"]) == (3, 8, 4)
    assert list(found["filters"]) == ["ekf", "ideal"]
    assert found["command"].startswith("jaxslam consistency --scenario circle")


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
    ],
)
def test_bad_input_exits_with_2_and_writes_nothing(tmp_path, capsys, change, message):
    out = tmp_path / "results"
    assert cli.main([*QUICK, *change, "--out", str(out)]) == 2
    assert message in capsys.readouterr().err
    assert not out.exists()


def test_an_unwritable_folder_exits_with_2_before_any_work(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(cli, "monte_carlo", lambda *a, **k: pytest.fail("work was begun"))
    (tmp_path / "file").write_text("")
    assert cli.main([*QUICK, "--out", str(tmp_path / "file")]) == 2
    assert "not a folder" in capsys.readouterr().err


def test_an_interrupt_exits_with_130_and_writes_nothing(tmp_path, capsys, monkeypatch):
    def interrupted(*arguments, progress, **options):
        progress(1, 3)
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "monte_carlo", interrupted)
    assert cli.main([*QUICK, "--out", str(tmp_path / "out")]) == 130
    assert "nothing was written" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_no_command_exits_with_2(capsys):
    assert cli.main([]) == 2
    assert "usage" in capsys.readouterr().err


def test_the_module_runs_as_a_program_in_float32(tmp_path):
    arguments = [*QUICK, "--dtype", "float32", "--out", str(tmp_path)]
    done = subprocess.run(
        [sys.executable, "-m", "jaxslam", *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "consistency.json").read_text())["dtype"] == "float32"
