"""Campaigns over real processes on this machine: the same bits, and nothing lost with one of them."""

import itertools
import json
import os
import signal
import socket
import time

import jax
import killed

from jaxslam import cli
from jaxslam.results import campaign_files

RUNS = 25


def arguments(out, *more, runs=RUNS):
    asked = ["--scenario", "circle", "--filters", "dead_reckoning", "--steps", "12", "--no-bound"]
    asked += ["--runs", str(runs)]
    shape = ["--devices", "1", "--block", "2", "--out", str(out)]
    return ["consistency", *asked, *shape, *more]


def begun(said, asked):
    """A process of the command, and the file of what it says."""
    return killed.started(killed.command, asked, said), said


def together(out, count, **options):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    where = ["--coordinator", f"127.0.0.1:{port}", "--processes", str(count), "--timeout", "60"]
    return [
        begun(
            out.with_name(f"{out.name} said {i}"),
            arguments(out, *where, "--process-id", str(i), **options),
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
    codes = [killed.end(process) for process, _ in processes]
    said = [file.read_text() for _, file in processes]
    assert codes == [0, 0, 0], said
    assert ["verdict" in text for text in said] == [True, False, False]
    assert results(shared) == results(alone)


def interrupt(process):
    """JAX's callback of the garbage collector swallows a Ctrl-C that falls into it; the next one is
    heard."""
    for _ in range(3):
        os.kill(process.pid, signal.SIGINT)
        process.join(15)
        if process.exitcode is not None:
            return
    process.kill()
    process.join()


def test_a_killed_process_loses_no_finished_run(tmp_path):
    many = {"runs": 20_000}  # so many that they are not done before one is killed
    out = tmp_path / "out"
    (one, _), (other, _) = together(out, 2, **many)
    blocks = out / "blocks"
    deadline = time.monotonic() + 200
    while len(list(blocks.glob("*.npz"))) < 6 and time.monotonic() < deadline:
        time.sleep(0.05)
    other.kill()
    one.kill()  # it would wait for the other until its heartbeat is missed
    for process in (one, other):
        assert killed.end(process) == -signal.SIGKILL
    done = {path.name: path.read_bytes() for path in blocks.glob("block-*.npz")}
    assert len(done) >= 6

    stale = sorted(done)[-1]
    again = arguments(out, **many)
    again[again.index("--out")] = "--resume"
    resumed, file = begun(tmp_path / "said", again)
    count = len(done)
    while len(list(blocks.glob("*.npz"))) < count + 4 and time.monotonic() < deadline + 200:
        time.sleep(0.05)
    interrupt(resumed)
    said = file.read_text()
    assert resumed.exitcode == 130, said
    assert f"of {many['runs']} runs done" in said
    assert "--resume" in said
    now = {path.name: path.read_bytes() for path in blocks.glob("block-*.npz")}
    assert len(now) > count
    assert all(now[name] == content for name, content in done.items())  # none was run again
    spans = sorted(tuple(map(int, name[6:-4].split("-"))) for name in now)
    assert all(end <= first for (_, end), (first, _) in itertools.pairwise(spans))
    assert stale in now
