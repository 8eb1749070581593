"""The command: files, exit codes, and nothing left behind after bad input or an interrupt."""

import json
import os
import re
import subprocess
import sys

import jax
import numpy as np
import pytest
from worlds import three_parameters

import jaxslam
from jaxslam import _cli as cli
from jaxslam import catalog, scenarios
from jaxslam.consistency.campaign import Interrupted
from jaxslam.results import _campaign_files, _files

QUICK = ["consistency", "--scenario", "circle", "--steps", "8", "--runs", "3"]


def test_consistency_prints_a_table_and_writes_everything(tmp_path, capsys, monkeypatch, undrawn):
    out, filmed = tmp_path / "results", []
    monkeypatch.setattr(cli.consistency, "write_films", lambda *a: filmed.append(a) or 0)
    options = ["--filters", "dead_reckoning,localization", "--no-bound", "--seed", "4", "--animate"]
    shape = ["--block", "1", "--devices", "1"]
    assert cli.main([*QUICK, *options, *shape, "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "verdict" in printed
    assert "published" not in printed  # of 2500 steps, and these are 8
    wrote, last = printed.splitlines()[-2:]
    assert wrote.startswith(f"wrote {out / 'report.html'}, ")
    assert re.fullmatch(
        r".* s in all, .* s of them to compile or load \d+ programs: \d+ compiled, \d+ loaded from the cache",
        last,
    )
    names = {path.name for path in out.iterdir()}
    assert names == {"blocks", *_campaign_files.file_names(["png"])}
    assert names == {
        "blocks",
        "report.html",
        "consistency.json",
        "consistency.csv",
        "measures.csv",
        *(f"{n}.png" for n in ("nees", "rmse", "cost", "coverage", "whiteness", "gained")),
        *(f"{n}.png" for n in ("errors", "map")),
    }
    result = json.loads((out / "consistency.json").read_text())
    assert (result["runs"], result["steps"], result["seed"]) == (3, 8, 4)
    assert list(result["filters"]) == ["dead_reckoning", "localization"]
    assert result["command"].startswith("jaxslam consistency --scenario circle")
    ((folder, world, filters, *rest),) = filmed
    assert (folder, world.name, list(filters), rest) == (
        out,
        "circle",
        ["dead_reckoning", "localization"],
        [4, "float64"],
    )


def test_the_version_is_told(capsys):
    assert cli.main(["--version"]) == 0
    line = capsys.readouterr().out
    assert f"(jax {jax.__version__}, Python 3." in line and jaxslam.__version__ in line


def test_the_report_of_a_problem_has_versions_devices_and_settings(capsys, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false")
    monkeypatch.setenv("UNRELATED", "secret")
    assert cli.main(["--version", "--verbose"]) == 0
    lines = capsys.readouterr().out.split("\n")
    assert f"numpy {np.__version__}" in lines and "device 0: cpu, cpu" in lines
    assert "XLA_FLAGS=--xla_cpu_enable_fast_math=false" in lines
    assert not [line for line in lines if "secret" in line]


def test_a_platform_without_its_device_is_one_line(capsys, monkeypatch, refused):
    """As JAX_PLATFORMS=cuda without a GPU."""

    def devices():
        raise RuntimeError("Unable to initialize backend 'cuda'\nno driver")

    monkeypatch.setattr(jax, "devices", devices)
    message = refused(QUICK, "jaxslam: JAX finds no device", "initialize backend 'cuda')")
    assert message.count("\n") == 1
    assert cli.main(["--version", "--verbose"]) == 0
    assert "device: none (RuntimeError: Unable to" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--scenario", "moon"], "--scenario: unknown scenario 'moon'"),
        (["--filters", "ekf,magic"], "--filters: unknown filter 'magic'"),
        (["--runs", "0"], "--runs: expected an integer >= 1, got 0"),
        (["--runs", "many"], "invalid int"),
        (["--steps", "0"], "--steps: expected an integer >= 1"),
        (["--block", "-1"], "--block: expected"),
        (["--seed", "-1"], "seed"),
        (["--dtype", "float16"], "invalid choice"),
        (["--devices", "0"], "--devices: expected at least 1"),
        (
            ["--devices", "99"],
            "--devices: expected at most 4, the number of devices here (CPU cores)",
        ),
        (["--filters", ""], "--filters: expected names of filters, or FILE.py:NAME, with commas"),
        (["--filters", "ekf,"], "or all, got 'ekf,'"),
        (["--cache", ""], "--cache: expected a folder, got ''"),
        (["--resume", " "], "--resume: expected a folder, got ' '"),
        (
            ["--compare", "ekv"],
            "--compare: expected one of --filters, dead_reckoning, ekf, got 'ekv' (did you mean "
            "ekf?)",
        ),
        (
            ["--filters", "ekf", "--compare", "ekf"],
            "--compare: expected two --filters or more, got 1",
        ),
        (["--compare", "ekf", "--runs", "1"], "--compare: expected two --runs or more, got 1"),
        (["--devices", "abacus"], "--devices: expected all, a number, or one of cpu"),
    ],
)
def test_bad_input_exits_with_2_and_writes_nothing(tmp_path, refused, change, message):
    refused([*QUICK, *change, "--out", tmp_path / "results"], message)
    assert not (tmp_path / "results").exists()


def test_no_more_devices_are_made_than_there_are_cores(monkeypatch):
    updates = {}
    monkeypatch.setattr(jax.config, "update", updates.__setitem__)
    for devices, count in (("99", cli.common.cores()), ("1", 1), ("all", cli.common.cores())):
        cli.common.set_device_count(devices)
        assert updates == {"jax_num_cpu_devices": count}


@pytest.mark.parametrize("asked", ["all", "fastslam1,fastslam2,particle_localization"])
def test_particles_are_named_as_any_filter_and_all_spans_them(tmp_path, monkeypatch, asked):
    seen = []

    def begun(scenario, filters, *arguments, **options):
        seen.extend(filters)
        raise Interrupted(None, 3)

    monkeypatch.setattr(cli.consistency, "monte_carlo", begun)
    assert cli.main([*QUICK, "--filters", asked, "--out", str(tmp_path / "out")]) == 130
    assert seen == (list(catalog.ALL) if asked == "all" else list(catalog.KINDS["particles"]))


def test_a_filter_that_cannot_run_a_scenario_is_refused_by_name(tmp_path, refused, monkeypatch):
    monkeypatch.setattr(
        cli.consistency, "monte_carlo", lambda *a, **k: pytest.fail("work was begun")
    )
    monkeypatch.setitem(scenarios.SCENARIOS, "signs", lambda steps: three_parameters())
    asked = ["consistency", "--scenario", "signs", "--steps", "5", "--filters", "ekf,fej"]
    parts = (
        "--filters: fej cannot run scenario 'ring'",
        "needs landmarks (x, y), not those of range_bearing_signature: choose linearize.AtEst",
        "those of the catalog that can: --filters ekf,ideal,iterated,square_root,ukf,",
    )
    said = refused([*asked, "--out", tmp_path], *parts)
    assert "chart" not in said and "fej" not in said.split("can: ")[1]


def test_an_unwritable_folder_exits_with_2_before_any_work(tmp_path, refused, monkeypatch):
    monkeypatch.setattr(
        cli.consistency, "monte_carlo", lambda *a, **k: pytest.fail("work was begun")
    )
    (tmp_path / "file").write_text("")
    out = tmp_path / "file" / "deeper" / "out"
    assert refused([*QUICK, "--out", out]) == (
        f"jaxslam: results cannot be written to {out}: {tmp_path / 'file'} is not a folder\n"
    )

    def read_only(dir):
        raise PermissionError(13, "Permission denied", f"{dir}/tmpxyz")

    monkeypatch.setattr(_files.tempfile, "TemporaryFile", read_only)
    out = tmp_path / "not" / "there"
    message = refused([*QUICK, "--out", out])
    assert message == f"jaxslam: results cannot be written to {out}: Permission denied\n"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "jaxslam: the following arguments are required: COMMAND; jaxslam --help describes"),
        (["consistancy"], "jaxslam: unknown command 'consistancy' (did you mean consistency?)"),
        (
            ["consistency", "--rnus", "3"],
            "jaxslam consistency: unrecognized arguments: --rnus 3 (did you mean --runs?); "
            "jaxslam consistency --help describes the options",
        ),
        (["consistency", "--run", "3"], "unrecognized arguments: --run 3 (did you mean --runs?)"),
        (["verify", "--qq"], "jaxslam verify: unrecognized arguments: --qq; jaxslam verify --help"),
        (["verify", "--states", "1"], "jaxslam: --states: expected at least 2, got 1"),
    ],
)
def test_what_is_no_command_or_option_is_told_in_a_line(refused, arguments, message):
    assert refused(arguments, message).count("\n") == 1


AS_A_PROGRAM = """
import runpy, sys
import jaxslam._cli
print(*sys.modules)
sys.argv[0] = "jaxslam"
runpy.run_module("jaxslam", run_name="__main__", alter_sys=True)
"""
"""What `python -m jaxslam` does, after a line with the modules that the command has imported."""


def test_the_module_runs_as_a_program_in_float32_and_imports_late_what_draws(tmp_path):
    # One step has no pose NEES.
    options = f"--steps 1 --filters dead_reckoning --dtype float32 --out {tmp_path}".split()
    done = subprocess.run(
        [sys.executable, "-c", AS_A_PROGRAM, *QUICK, *options],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    modules, _, said = done.stdout.partition("\n")
    assert "jaxslam._cli" in modules.split()
    assert {"matplotlib", "scipy.optimize", "scipy.stats"}.isdisjoint(modules.split())
    assert "The filters ran in float32: for float64" in said
    assert json.loads((tmp_path / "consistency.json").read_text())["dtype"] == "float32"
    assert (tmp_path / "nees.png").read_bytes().startswith(b"\x89PNG")


WITH_ITS_FIGURE = """
import hashlib, sys
from jaxslam import plot
figure, (axes,) = plot.panels_of(2, 1, 1)
plot.titled(axes, "x")
figure.savefig(sys.argv[1])
"""


def test_a_figure_is_drawn_where_the_users_backend_latex_or_settings_are_of_no_use(tmp_path):
    (tmp_path / "matplotlibrc").write_text("text.usetex: True\nsavefig.dpi: 20\n")
    (tmp_path / "latin").mkdir()
    (tmp_path / "latin" / "matplotlibrc").write_bytes("# Größe\nfont.size: 20\n".encode("latin-1"))
    without = {k: v for k, v in os.environ.items() if k not in ("MPLBACKEND", "MATPLOTLIBRC")}
    settings = {"MPLBACKEND": "module://of_a.notebook", "MATPLOTLIBRC": str(tmp_path)}
    latin = {"MATPLOTLIBRC": str(tmp_path / "latin")}
    for name, folder, more in (
        ("usual", tmp_path.parent, {}),
        ("other", tmp_path.parent, settings),
        ("latin", tmp_path.parent, latin),
        ("here", tmp_path / "latin", {}),
    ):
        subprocess.run(
            [sys.executable, "-W", "error", "-c", WITH_ITS_FIGURE, tmp_path / f"{name}.png"],
            check=True,
            cwd=folder,
            env=without | more,
        )
    usual = (tmp_path / "usual.png").read_bytes()
    for name in ("other", "latin", "here"):
        assert (tmp_path / f"{name}.png").read_bytes() == usual, name


def test_numbers_are_written_before_figures_and_one_that_fails_is_named(tmp_path, capsys):
    (tmp_path / "map.pdf").write_text("of an earlier command")
    (tmp_path / "map.csv").write_text("earlier")

    def fails():
        assert (tmp_path / "map.csv").read_text() == "numbers"
        raise RuntimeError("latex could not be found\nin a hundred lines")

    drawings = {"map": fails, "graph": lambda: {"graph.png": b"drawn"}}
    assert cli.common.write_results(tmp_path, {"map.csv": "numbers"}, drawings) == cli.common.FAILED
    assert {path.name for path in tmp_path.iterdir()} == {"map.csv", "graph.png"}
    printed = capsys.readouterr()
    assert f"wrote {tmp_path / 'map.csv'}, {tmp_path / 'graph.png'}" in printed.out
    assert printed.err.startswith("jaxslam: map was not drawn: ")
    assert printed.err.endswith("RuntimeError: latex could not be found\n")


def test_an_interrupt_while_a_figure_is_drawn_says_what_is_written(tmp_path, monkeypatch, capsys):
    def interrupted():
        raise KeyboardInterrupt

    def command(options, _):
        return cli.common.write_results(options.out, {"a.csv": "1"}, {"map": interrupted})

    monkeypatch.setattr(cli.verify, "verify_models", command)
    assert cli.main(["verify", "--out", str(tmp_path)]) == cli.common.INTERRUPTED
    assert f"interrupted; wrote {tmp_path / 'a.csv'}" in capsys.readouterr().err


def test_a_closed_pipe_ends_the_command_silently(tmp_path, monkeypatch, capfd):
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as closed, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", closed)
        patch.setattr(cli.verify, "verify_models", lambda *a: print("report") or 0)
        assert cli.main(["verify", "--out", str(tmp_path)]) == 141
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("given", "called"),
    [
        (
            "run --dataset carmen a.log --mount -1,0,90",
            "slam a.log --mount -1,0,90 --dataset carmen",
        ),
        ("run a.log --relations r --dataset=carmen", "slam a.log --relations r --dataset carmen"),
        (
            "run --dataset carmen a.log --map known --every 2",
            "map a.log --every 2 --dataset carmen",
        ),
        ("run --dataset carmen a.log --localize m.yaml", "localize m.yaml a.log --dataset carmen"),
        ("run --dataset rosbag a.bag --list", "slam a.bag --list --dataset rosbag"),
        ("run --dataset table carmen", "run --dataset table carmen"),
        ("slam carmen", "slam carmen"),
    ],
)
def test_run_of_a_laser_log_is_a_command_of_its_own(given, called):
    assert cli._laser_command(given.split()) == called.split()
