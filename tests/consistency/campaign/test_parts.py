"""Parts of a campaign, each computed as if alone: in any order, twice or not at all; the same bits."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import jax
import numpy as np
import pytest
import worlds
from command import run_command

from jaxslam import filters, store
from jaxslam.consistency.campaign import monte_carlo
from jaxslam.results import _campaign_files as campaign_files

WORLD = worlds.ring(20)
RECKONING = filters.DeadReckoning(WORLD.motion, WORLD.sensor)
SCRIPT = Path(__file__).parents[3] / "examples" / "slurm_campaign.sh"


def campaign_of(runs=10, **options):
    """Blocks of four runs."""
    options |= {"block": 4, "devices": jax.devices()[:1]}
    return monte_carlo(WORLD, {"reckoning": RECKONING}, runs, worlds.key(), **options)


@pytest.fixture(scope="module")
def whole():
    return campaign_of(runs=22)


def blocks(folder):
    return [first // 4 for first, _ in store.resume(folder).spans()]


def test_parts_missing_doubled_and_rerun_sum_up_to_one_go(tmp_path, whole):
    def part(i, runs=22):
        return campaign_of(runs, keep=store.open(tmp_path, runs=runs), part=(i, 3))

    last = part(3)
    assert blocks(tmp_path) == [2, 5]
    assert last.run_numbers.tolist() == [8, 9, 10, 11, 20, 21]
    assert part(1, 22).runs == 8
    before = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    worlds.assert_same_bits(part(3), last)  # again: its runs are there
    assert {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == before
    assert blocks(tmp_path) == [0, 2, 3, 5]
    heard = []
    found = campaign_of(22, keep=store.resume(tmp_path), progress=lambda *done: heard.append(done))
    assert heard[-1] == (8, 8)  # part 2 alone
    worlds.assert_same_bits(found, whole)
    # Two of the same part at once: neither knows of the other's blocks.
    doubled = [store.open(tmp_path / "b", runs=22) for _ in range(2)]
    worlds.assert_same_bits(*(campaign_of(22, keep=keep, part=(2, 3)) for keep in doubled))


def test_parts_extend_a_campaign_and_do_not_shorten_it(tmp_path, whole):
    for i in np.arange(1, 3):  # of NumPy, as of a grid of jobs
        campaign_of(10, keep=store.open(tmp_path, runs=10), part=(i, 2))
    for i in (2, 1):
        campaign_of(22, keep=store.open(tmp_path, runs=22), part=(i, 2))
    assert store.resume(tmp_path).runs == 22
    worlds.assert_same_bits(campaign_of(22, keep=store.resume(tmp_path)), whole)
    with pytest.raises(ValueError, match="is to have 22 runs: expected at least as many, got 10"):
        store.open(tmp_path, runs=10)


@pytest.mark.parametrize("part", [(0, 2), (3, 2), (1.0, 2), "1/2", (1, 2, 3), (True, 2)])
def test_a_part_is_two_numbers(part):
    with pytest.raises(ValueError, match=r"part: expected \(i, n\) with 1 <= i <= n, got"):
        campaign_of(part=part)


def test_a_part_without_a_block_says_so():
    with pytest.raises(ValueError, match="the 3 blocks of 4 runs that 10 runs are, got part 4 of"):
        campaign_of(part=(4, 16))


@pytest.mark.parametrize("links", [True, False])
def test_of_processes_that_begin_at_once_one_makes_the_manifest(tmp_path, links, monkeypatch):
    """In each round four threads have one identity, and four another: all of one kind go on."""
    if not links:  # as on a file system without; then not all at once

        def no_links(*_):
            raise OSError(95, "not supported")

        monkeypatch.setattr(os, "link", no_links)
    rounds, count = (25, 8) if links else (3, 2)
    for number in range(rounds):
        folder, ready, fates = tmp_path / str(number), threading.Barrier(count), {}

        def begin(i, folder=folder, ready=ready, fates=fates):
            ready.wait()
            kept = store.open(folder, {"seed": 0}, 10)
            if not links and i:
                ready.wait()
            try:
                kept.claim({"jax": f"0.{i % 2}"})
                fates[i] = ""
            except ValueError as error:
                fates[i] = str(error)
            if not links and not i:
                ready.wait()

        threads = [threading.Thread(target=begin, args=(i,)) for i in range(count)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        accepted = {i % 2 for i, said in fates.items() if not said}
        assert len(fates) == count and len(accepted) == 1
        (winner,) = accepted
        assert all((i % 2 == winner) == (not said) for i, said in fates.items())
        assert store.resume(folder).campaign == {"jax": f"0.{winner}"}
        assert [path.name for path in folder.iterdir()] == ["manifest.json"]
        with pytest.raises(ValueError, match="seed: 0 there, 1 here"):
            store.open(folder, {"seed": 1})


ASKED = ["--scenario", "circle", "--filters", "dead_reckoning", "--steps", "12", "--block", "2"]


@pytest.fixture(scope="module", autouse=True)
def undrawn():
    """Reports have no figures."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(campaign_files, "_drawings", lambda *_: {})
        yield


def command(out, *options):
    return run_command(["consistency", *ASKED, "--runs", "13", "--out", str(out), *options])


def results(out):
    return (out / "consistency.csv").read_text()


@pytest.fixture(scope="module")
def in_one_go(tmp_path_factory):
    out = tmp_path_factory.mktemp("whole")
    jax.devices()  # before the command can ask for another number of them
    assert command(out, "--devices", "1") == 0
    return out


@pytest.mark.sweep
def test_the_command_computes_a_part(tmp_path, capsys, in_one_go):
    out = tmp_path / "out"
    # A process was killed as it made the manifest.
    (out / "blocks").mkdir(parents=True)
    (out / "blocks" / ".manifest.json-1-ab.tmp").write_text("{")
    for part in ("2/3", "1/3", "2/3"):
        assert command(out, "--devices", "1", "--part", part) == 0
        assert f"part {part[0]} of 3 is done, " in capsys.readouterr().out
    assert not (out / "consistency.json").exists()
    assert command(out, "--devices", "1", "--part", "9/9") == 0
    assert "part 9 of 9 has no block of the 13 runs" in capsys.readouterr().out
    for options, message in (
        (["--devices", "1", "--seed", "3"], "--seed is 0 there, 3 here: choose another folder"),
        (["--devices", "2"], "--devices is 1 there, 2 here"),
        (["--devices", "1", "--block", "4"], "--block is 2 there, 4 here"),
        (
            ["--devices", "1", "--runs", "12"],
            "is to have 13 runs: expected at least as many, got 12",
        ),
        (["--devices", "1", "--overwrite"], "--part: expected no --overwrite"),
    ):
        assert command(out, "--part", "1/3", *options) == 2
        assert message in capsys.readouterr().err
    for part in ("0/3", "4/3", "3", "a/3"):
        assert command(out, "--part", part) == 2
        assert f"--part: expected I/N with 1 <= I <= N, as 3/16, got '{part}'" in (
            capsys.readouterr().err
        )
    assert run_command(["consistency", "--resume", str(out), "--part", "1/9"]) == 0
    assert run_command(["consistency", "--resume", str(out)]) == 0  # with the devices of the parts
    assert results(out) == results(in_one_go)
    assert command(in_one_go, "--devices", "1", "--part", "1/2") == 2
    assert (
        "--devices is not given there, 1 here: give all parts the same" in capsys.readouterr().err
    )


@pytest.mark.sweep
def test_the_job_array_of_the_documentation(tmp_path, in_one_go):
    """Its script, by processes at once in place of SLURM's jobs; one of three never comes."""
    (tmp_path / "jaxslam").write_text(f'#!/bin/sh\nexec {sys.executable} -m jaxslam "$@"\n')
    (tmp_path / "jaxslam").chmod(0o755)
    words = [*ASKED, "--runs", "13"]
    jobs = []
    for i in (1, 3):
        variables = {"ARRAY_TASK_ID": i, "ARRAY_TASK_COUNT": 3, "CPUS_PER_TASK": 1}
        variables["SUBMIT_DIR"] = tmp_path
        env = os.environ | {f"SLURM_{name}": str(value) for name, value in variables.items()}
        env["PATH"] = f"{tmp_path}:{env['PATH']}"
        jobs.append(subprocess.Popen(["bash", SCRIPT, *words], env=env, stdout=subprocess.PIPE))
    said = [job.communicate(timeout=300)[0].decode() for job in jobs]
    assert [job.returncode for job in jobs] == [0, 0], said
    out = tmp_path / "campaign"
    spans = store.resume(out / "blocks").spans()
    assert [first for first, _ in spans] == [0, 4, 6, 10, 12]
    assert run_command(["consistency", "--resume", str(out)]) == 0
    assert results(out) == results(in_one_go)
