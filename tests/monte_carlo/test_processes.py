"""Campaigns over real processes on this machine: the same bits, and nothing lost with one of them."""

import itertools
import json
import os
import signal
import socket
import subprocess
import sys
import time

import jax

from jaxslam import cli
from jaxslam.results import campaign_files

RUNS = 25
UNDRAWN = """
import sys
from jaxslam import cli
from jaxslam.results import campaign_files
campaign_files._drawings = lambda *_: {}
sys.exit(cli.main())
"""
"""The command, whose report has no figures."""


def arguments(out, *more, runs=RUNS):
    asked = ["--scenario", "circle", "--filters", "dead_reckoning", "--steps", "12", "--no-bound"]
    asked += ["--runs", str(runs)]
    shape = ["--devices", "1", "--block", "2", "--out", str(out)]
    return ["consistency", *asked, *shape, *more]


def command(out, *more, **options):
    return [sys.executable, "-c", UNDRAWN, *arguments(out, *more, **options)]


def together(out, count, *more, **options):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    where = ["--coordinator", f"127.0.0.1:{port}", "--processes", str(count), "--timeout", "60"]
    return [
        subprocess.Popen(
            command(out, *where, "--process-id", str(i), *more, **options),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for i in range(count)
    ]


def results(out):
    found = json.loads((out / "consistency.json").read_text())
    for name in ("seconds", "compile_seconds", "step_seconds", "command"):
        del found[name]
    return found, (out / "consistency.csv").read_text()


def test_three_processes_together_are_one_alone(tmp_path, monkeypatch):
    """One alone by the command in this process; the others find its programs on the disk."""
    alone, shared = tmp_path / "alone", tmp_path / "shared"
    jax.devices()  # before the command can ask for another number of them
    monkeypatch.setattr(campaign_files, "_drawings", lambda *_: {})
    assert cli.main(arguments(alone)) == 0
    processes = together(shared, 3)
    said = [process.communicate(timeout=300)[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0, 0], said
    assert ["verdict" in text for text in said] == [True, False, False]
    assert results(shared) == results(alone)


def interrupted(process):
    """What a process says that is interrupted. JAX's callback of the garbage collector swallows a
    Ctrl-C that falls into it; the next one is heard."""
    for _ in range(3):
        process.send_signal(signal.SIGINT)
        try:
            return process.communicate(timeout=15)[0]
        except subprocess.TimeoutExpired:
            pass
    process.kill()
    return process.communicate()[0]


def test_a_killed_process_loses_no_finished_run(tmp_path):
    many = {"runs": 20_000}  # so many that they are not done before one is killed
    processes = together(tmp_path, 2, **many)
    blocks = tmp_path / "blocks"
    deadline = time.monotonic() + 200
    while len(list(blocks.glob("*.npz"))) < 6 and time.monotonic() < deadline:
        time.sleep(0.05)
    os.kill(processes[1].pid, signal.SIGKILL)
    processes[0].kill()  # it would wait for the other until its heartbeat is missed
    for process in processes:
        process.communicate(timeout=60)
    done = {path.name: path.read_bytes() for path in blocks.glob("block-*.npz")}
    assert len(done) >= 6

    stale = sorted(done)[-1]
    again = command(tmp_path, **many)
    again = [
        *again[: again.index("--out")],
        "--resume",
        str(tmp_path),
        *again[again.index("--out") + 2 :],
    ]
    # Where pytest runs in the background SIGINT is ignored, and children inherit that.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    resumed = subprocess.Popen(again, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    signal.signal(signal.SIGINT, before)
    count = len(done)
    while len(list(blocks.glob("*.npz"))) < count + 4 and time.monotonic() < deadline + 200:
        time.sleep(0.05)
    said = interrupted(resumed)
    assert resumed.returncode == 130, said
    assert f"of {many['runs']} runs done" in said
    assert "--resume" in said
    now = {path.name: path.read_bytes() for path in blocks.glob("block-*.npz")}
    assert len(now) > count
    assert all(now[name] == content for name, content in done.items())  # none was run again
    spans = sorted(tuple(map(int, name[6:-4].split("-"))) for name in now)
    assert all(end <= first for (_, end), (first, _) in itertools.pairwise(spans))
    assert stale in now
