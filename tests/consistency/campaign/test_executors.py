"""Campaigns on executors: the bits of one process, whatever happens to workers."""

import multiprocessing
import os
import pickle
import re
import signal
import subprocess
import sys
import time
import warnings
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from multiprocessing import get_context
from threading import Thread

import broken
import jax
import numpy as np
import pytest
import worlds

import jaxslam
from jaxslam import _cli as cli
from jaxslam import filters, store
from jaxslam.consistency.campaign import (
    Incomplete,
    Processes,
    _block,
    _flight,
    _remote,
    monte_carlo,
)
from jaxslam.core.record import record

WORLD = worlds.ring(20)
RECKONING = filters.DeadReckoning(WORLD.motion, WORLD.sensor)


def campaign_of(runs=22, **options):
    """Blocks of four runs."""
    return monte_carlo(WORLD, {"reckoning": RECKONING}, runs, worlds.key(), block=4, **options)


@pytest.fixture(scope="module")
def undivided():
    return campaign_of(devices=jax.devices()[:1])


class Unreliable:
    """An executor whose first workers do something else; `calls` are the runs that began."""

    def __init__(self, *fates):
        self.fates, self.calls = list(fates), []

    def submit(self, function, plan, first, runs):
        self.calls.append(first)
        future = Future()
        fate = self.fates.pop(0) if self.fates else None
        if isinstance(fate, BaseException):
            future.set_exception(fate)
        elif fate == "cancelled":
            future.cancel()
        elif fate != "lost":
            future.set_result(pickle.loads(pickle.dumps(function(plan, first, runs))))
        return future


class Job:
    """What submitit returns: no future of the standard library."""

    def __init__(self, future):
        self.done, self.result, self.exception = future.done, future.result, future.exception


class Jobs(ThreadPoolExecutor):
    def submit(self, *arguments):
        return Job(super().submit(*arguments))


@pytest.mark.parametrize("kind", [ThreadPoolExecutor, Jobs])
def test_an_executor_gives_the_bits_of_one_process(kind, undivided, tmp_path):
    said, compiled = [], _remote._runner.cache_info().misses
    with kind(2) as executor:
        campaign = campaign_of(
            executor=executor,
            keep=store.open(tmp_path),
            progress=lambda *done: said.append(done),
        )
    worlds.assert_same_bits(campaign, undivided)
    assert said[-1] == (22, 22) and len(said) == 6
    assert _remote._runner.cache_info().misses <= compiled + 1  # two threads compile once
    assert campaign.compile_seconds > 0 and set(campaign.step_seconds) == {"reckoning"}
    for result, expected in zip(
        campaign.first["reckoning"], undivided.first["reckoning"], strict=True
    ):
        np.testing.assert_array_equal(result.pose, expected.pose)
    # What is kept is not computed again, here or there.
    worlds.assert_same_bits(
        campaign_of(keep=store.resume(tmp_path), executor=Unreliable()), undivided
    )


def test_a_block_whose_worker_dies_or_fails_is_computed_again(undivided):
    executor = Unreliable(OSError("gone"), None, "cancelled", OSError("gone"), None, None)
    with pytest.warns(UserWarning, match="computed once more") as warned:
        campaign = campaign_of(executor=executor, workers=1)
    worlds.assert_same_bits(campaign, undivided)
    assert len(warned) == 3 and len(executor.calls) == 6 + 3
    assert "runs 0 to 3 are computed once more (OSError: gone)" in str(warned[0].message)


def test_a_block_that_is_late_is_computed_again(undivided, monkeypatch):
    monkeypatch.setattr(_flight, "_LATE", 0.2)
    executor = Unreliable(None, "lost")
    with pytest.warns(UserWarning, match="no result after"):
        worlds.assert_same_bits(campaign_of(executor=executor), undivided)
    assert executor.calls.count(4) == 2
    monkeypatch.setattr(_flight, "_LATE", 0.05)
    lost = Unreliable(None, *["lost"] * 30)
    with warnings.catch_warnings(), pytest.raises(Incomplete, match="4 of 22 runs done"):
        warnings.simplefilter("ignore")
        campaign_of(executor=lost)


def test_a_campaign_that_cannot_be_finished_says_what_it_has(undivided, tmp_path):
    executor = Unreliable(None, None, *[OSError("gone")] * 50)
    keep = store.open(tmp_path)
    with warnings.catch_warnings(), pytest.raises(Incomplete, match="OSError: gone") as stopped:
        warnings.simplefilter("ignore")
        campaign_of(executor=executor, workers=1, keep=keep)
    assert "8 of 22 runs done" in str(stopped.value)
    assert stopped.value.campaign.runs == 8 and keep.done() == 8
    worlds.assert_same_bits(
        campaign_of(executor=Unreliable(), keep=store.resume(tmp_path)), undivided
    )


def test_a_pool_that_breaks_at_once_asks_for_the_guard_of_a_script():
    broken = Unreliable(*[BrokenExecutor("terminated abruptly")] * 50)
    with (
        warnings.catch_warnings(),
        pytest.raises(Incomplete, match=r"under `if __name__ == '__main__':`.*0 of 22 runs"),
    ):
        warnings.simplefilter("ignore")
        campaign_of(executor=broken)


def test_an_error_of_the_store_is_not_taken_for_one_of_the_executor(tmp_path, monkeypatch):
    def full(*_):
        raise OSError("no space left")

    keep = store.open(tmp_path)
    monkeypatch.setattr(type(keep), "save", full)
    with pytest.raises(OSError, match="no space left"):
        campaign_of(executor=Unreliable(), workers=1, keep=keep)


def test_an_error_of_the_code_is_not_tried_again():
    executor = Unreliable(ValueError("wrong on every worker"))
    with pytest.raises(ValueError, match="wrong on every worker"):
        campaign_of(executor=executor, workers=1)
    assert len(executor.calls) <= 2


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (
            {"executor": 4},
            r"monte_carlo: executor: expected one of concurrent\.futures, with a method",
        ),
        (
            {"executor": lambda: Unreliable},
            r"monte_carlo: executor: expected one of concurrent\.futures, with a method",
        ),
        ({"executor": Unreliable(), "devices": jax.devices}, "each worker of an executor uses"),
    ],
)
def test_what_is_no_executor_is_refused(options, told):
    options = {name: value() if callable(value) else value for name, value in options.items()}
    with pytest.raises(ValueError, match=told):
        campaign_of(**options)


def test_what_cannot_be_pickled_is_refused(tmp_path, monkeypatch):
    def send():
        monte_carlo(WORLD, {"own": lambda truth: RECKONING}, 4, worlds.key(), executor=Unreliable())

    monkeypatch.setitem(sys.modules, "cloudpickle", None)
    with pytest.raises(ValueError, match=r"cannot be sent .*pip install cloudpickle"):
        send()
    broken.library(monkeypatch, tmp_path, "cloudpickle", {"": "raise AttributeError('opcode')"})
    with pytest.raises(ValueError, match=r"cannot be sent .*\(AttributeError: opcode\)"):
        send()


def test_a_class_of_a_script_is_a_record_in_another_process(tmp_path):
    """By cloudpickle, which makes the class anew there."""
    cloudpickle = broken.optional("cloudpickle")

    @record
    class Slow(jaxslam.motion.Unicycle):
        factor: float = 0.5

    (tmp_path / "sent").write_bytes(cloudpickle.dumps(Slow(np.eye(2))))
    script = "import pickle, jax, jaxslam; print(jax.tree.leaves(pickle.load(open('sent', 'rb'))))"
    ran = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert ran.stdout.split()[-1] == "0.5]"


def test_a_block_is_small_on_its_way():
    device = jax.devices()[:1]
    content = _remote.pack(
        _block.CampaignPlan(WORLD, {"reckoning": RECKONING}, worlds.key(), device, 4)
    )
    assert len(content) < 8000
    result = _remote.compute_block(content, 0, 4)
    assert len(pickle.dumps(result._replace(first={}))) < 20_000


# --- engines, tried for real -----------------------------------------------------------------


def killed(done, runs, before=frozenset()):
    """Kill a process that began since."""
    children = set(multiprocessing.active_children()) - before
    if done == 4:
        os.kill(min(child.pid for child in children), signal.SIGKILL)


@pytest.mark.sweep
def test_processes_of_which_one_is_killed(undivided, tmp_path):
    before = frozenset(multiprocessing.active_children())
    executor = Processes(2)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            campaign = campaign_of(
                executor=executor, progress=lambda *done: killed(*done, before=before)
            )
    finally:
        executor.shutdown()
    worlds.assert_same_bits(campaign, undivided)
    with (
        ProcessPoolExecutor(1, get_context("spawn")) as pool,
        warnings.catch_warnings(),
        pytest.raises(Incomplete, match="BrokenProcessPool"),
    ):
        warnings.simplefilter("ignore")
        campaign_of(400, executor=pool, progress=lambda *done: killed(*done, before=before))


@pytest.mark.sweep
def test_dask_with_a_worker_killed(undivided):
    distributed = broken.optional("distributed")
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        pids = list(client.run(os.getpid).values())
        killing = []

        def progress(done, runs):
            if not killing:
                killing.append(os.kill(pids[0], signal.SIGKILL))

        executor = client.get_executor(pure=False)
        campaign = campaign_of(400, executor=executor, progress=progress)
    assert killing
    worlds.assert_same_bits(campaign, campaign_of(400, devices=jax.devices()[:1]))


ASKED = ["--scenario", "circle", "--filters", "dead_reckoning", "--steps", "12", "--block", "2"]


def results(out):
    return (out / "consistency.csv").read_text()


@pytest.fixture(scope="module")
def in_one_go(tmp_path_factory):
    out = tmp_path_factory.mktemp("whole")
    jax.devices()  # before the command can ask for another number of them
    assert (
        cli.main(["consistency", *ASKED, "--runs", "32", "--devices", "1", "--out", str(out)]) == 0
    )
    return out


@pytest.mark.sweep
def test_the_command_on_processes(tmp_path, in_one_go):
    out = tmp_path / "out"
    options = ["--runs", "32", "--executor", "processes:2", "--out", str(out)]
    assert cli.main(["consistency", *ASKED, *options]) == 0
    assert results(out) == results(in_one_go)


@pytest.mark.sweep
def test_the_command_on_open_mpi(tmp_path, in_one_go):
    started = ["mpiexec", "--allow-run-as-root", "--oversubscribe", "-n", "3", sys.executable]
    options = ["--runs", "32", "--executor", "mpi", "--out", str(tmp_path / "out")]
    command = [*started, "-m", "mpi4py.futures", "-m", "jaxslam", "consistency", *ASKED, *options]
    options = {"capture_output": True, "text": True, "timeout": 300}
    try:
        tried = subprocess.run([*started, "-c", "from mpi4py import MPI"], **options)
    except FileNotFoundError:
        pytest.skip("mpiexec is not installed")
    if tried.returncode:
        pytest.skip(f"MPI cannot be used: {' '.join(tried.stderr.split())[:200]}")
    ran = subprocess.run(command, **options)
    assert ran.returncode == 0, ran.stderr
    assert results(tmp_path / "out") == results(in_one_go)


def test_an_address_that_does_not_answer_ends_the_command(tmp_path, capsys):
    broken.optional("distributed")
    began = time.monotonic()
    options = ["--executor", "dask://127.0.0.1:1", "--out", str(tmp_path / "out")]
    assert cli.main(["consistency", *ASKED, *options]) == 2
    assert "no Dask scheduler answers at 127.0.0.1:1" in capsys.readouterr().err
    assert time.monotonic() - began < 20
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--executor", "threads:2"], "expected processes:N, dask://HOST:PORT or mpi"),
        (["--executor", "processes:2", "--devices", "1"], "expected no --devices with it"),
        # One rank, or no library of MPI, or no mpi4py.
        (["--executor", "mpi"], "mpiexec -n 4|an MPI library|pip install 'jaxslam.mpi.'"),
    ],
)
def test_the_command_refuses(tmp_path, capsys, options, told):
    assert cli.main(["consistency", *ASKED, *options, "--out", str(tmp_path / "out")]) == 2
    assert re.search(told, capsys.readouterr().err)
    assert not (tmp_path / "out").exists()


NO_MPI = "raise RuntimeError('cannot load MPI library\\n libmpi.so: cannot open')"


@pytest.mark.parametrize(
    ("executor", "name", "sources", "version", "told"),
    [
        ("dask://127.0.0.1:1", "distributed", None, None, "pip install 'jaxslam[dask]'"),
        ("dask://127.0.0.1:1", "distributed", {"": "import dask.gone"}, None, "'dask.gone'"),
        ("dask://127.0.0.1:1", "distributed", {}, "2023.4.1", "2023.4.1 is too old"),
        (
            "mpi",
            "mpi4py",
            {"MPI": NO_MPI},
            None,
            "(RuntimeError: cannot load MPI library): install",
        ),
        ("mpi", "mpi4py", {}, "3.1.4", "mpi4py 3.1.4 is too old, expected 4.1 or later"),
    ],
)
def test_an_engine_that_cannot_be_used_is_named(
    tmp_path, capsys, monkeypatch, executor, name, sources, version, told
):
    if sources is None:
        monkeypatch.setitem(sys.modules, name, None)
    else:
        broken.library(monkeypatch, tmp_path, name, sources, version)
    out = tmp_path / "out"
    assert cli.main(["consistency", *ASKED, "--executor", executor, "--out", str(out)]) == 2
    written = capsys.readouterr().err
    assert told in written and written.startswith("jaxslam: --executor: ")
    assert written.count("\n") == 1 and not out.exists()


@pytest.mark.sweep
def test_a_service_that_is_not_dasks_ends_the_command(tmp_path, capsys, monkeypatch):
    """Dask's own time limit does not hold while it reads another protocol."""
    broken.optional("distributed")
    monkeypatch.setattr(cli.campaigns.engines, "_TIMEOUT", 1)
    with ThreadingHTTPServer(("127.0.0.1", 0), BaseHTTPRequestHandler) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        options = ["--executor", f"dask://127.0.0.1:{server.server_port}"]
        assert cli.main(["consistency", *ASKED, *options, "--out", str(tmp_path / "out")]) == 2
        server.shutdown()
    assert "no Dask scheduler answers at 127.0.0.1" in capsys.readouterr().err


def test_what_a_worker_lacks_is_named():
    """Of a class of a module that is not there, and of cloudpickle."""
    for content in (b"cnowhere_to_be_found\nCloud\n.", b"cjaxslam.motion\nNowhere\n."):
        with pytest.raises(
            ValueError, match=r"a worker cannot read what is sent .*owhere"
        ) as caught:
            _remote.compute_block(content, 0, 4)
        assert "\n" not in str(caught.value)
        assert pickle.loads(pickle.dumps(caught.value)).args == caught.value.args
