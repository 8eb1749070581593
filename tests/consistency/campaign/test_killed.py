"""Whatever ends a campaign, what is resumed is to the bit what would have been.

Processes are forked from one that has imported the package, but not begun to use JAX, and take
compiled programs from a folder: so each begins in a few tenths of a second.
"""

import errno
import multiprocessing
import os
import resource
import signal
import sys
import time
from multiprocessing import forkserver

import jax
import numpy as np
import pytest
import worlds

from jaxslam import filters, store
from jaxslam.consistency.campaign import monte_carlo

if sys.platform != "linux":
    pytest.skip("needs forkserver, SIGKILL and limits of resources", allow_module_level=True)

RUNS, BLOCK = 240, 2
FULL = 28
"""Exit code of a process whose disk was full."""


def campaign(**options):
    """A campaign of dead reckoning in blocks of two runs."""
    world = worlds.ring(20)
    candidates = {"reckoning": filters.DeadReckoning(world.motion, world.sensor)}
    options |= {"block": BLOCK, "devices": jax.devices()[:1]}
    return monte_carlo(world, candidates, RUNS, worlds.key(), **options)


def _begin(folder, programs, full_after):
    """The target of a process. full_after: from so many blocks on no file of this size is written."""
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_compilation_cache_dir", str(programs))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)

    def fill(done=0, total=0):
        if done >= full_after * BLOCK:
            resource.setrlimit(resource.RLIMIT_FSIZE, (200, resource.RLIM_INFINITY))

    limited = full_after is not None
    try:
        if limited:
            fill()
        campaign(keep=store.open(folder, runs=RUNS), progress=fill if limited else False)
    except OSError as error:
        full = error.errno == errno.EFBIG and "cannot write" in str(error)
        os._exit(FULL if full else 1)


def started(target, *arguments):
    """A process of the target, which is a function of this module."""
    context = multiprocessing.get_context("forkserver")
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join(sys.path)  # ignored by it, before Python 3.14
    try:
        context.set_forkserver_preload(["test_killed"])
        forkserver.ensure_running()
    finally:
        del os.environ["PYTHONPATH"]
        if before is not None:
            os.environ["PYTHONPATH"] = before
    process = context.Process(target=target, args=arguments)
    process.start()
    return process


def begin(folder, programs, full_after=None):
    """A process that computes what is missing of the campaign in a folder."""
    return started(_begin, folder, programs, full_after)


def end(process):
    """The exit code of a process, once it has ended by itself."""
    process.join()
    return process.exitcode


def blocks(folder):
    return len(list(folder.glob("block-*.npz")))


def kill_somewhere(folder, programs, rng):
    """Begin, or go on with, the campaign in a folder and kill it -9; its exit code.

    In one of three processes at any time of its start, else in the milliseconds after some blocks.
    """
    process, before = begin(folder, programs), blocks(folder)
    if rng.random() < 1 / 3:
        process.join(rng.uniform(0, 0.5))
    else:
        more = rng.integers(1, 8)
        while process.is_alive() and blocks(folder) < before + more:
            time.sleep(0.001)
        process.join(rng.uniform(0, 0.01))
    os.kill(process.pid, signal.SIGKILL)
    return end(process)


def set_clock_back(folder, rng):
    """Give the files of a folder times of a clock that was wrong: before all others, and to come."""
    for path in folder.iterdir():
        at = float(rng.choice([0.0, time.time() + 1e9 * rng.random()]))
        os.utime(path, (at, at))


def damage(folder, rng, count):
    """Truncate some blocks anywhere; their names."""
    chosen = rng.choice(sorted(folder.glob("block-*.npz")), count, replace=False)
    for path in chosen:
        os.truncate(path, int(rng.integers(0, np.maximum(path.stat().st_size, 1))))
    return sorted(path.name for path in chosen)


@pytest.fixture(scope="module")
def programs(tmp_path_factory):
    return tmp_path_factory.mktemp("programs")


@pytest.fixture(scope="module")
def undisturbed(programs, tmp_path_factory):
    folder = tmp_path_factory.mktemp("undisturbed")
    assert end(begin(folder, programs)) == 0
    return summed_up(folder)


def summed_up(folder):
    """The campaign in a folder, all of whose blocks are there, and valid."""
    made = store.resume(folder)
    assert made.done() == RUNS
    found = campaign(keep=made)
    assert found.compile_seconds == 0  # nothing was left to run
    assert made.set_aside == []
    return found


def test_ten_kills_anywhere_change_no_bit(tmp_path, programs, undisturbed):
    rng, codes = np.random.default_rng(), []
    while codes.count(-signal.SIGKILL) < 10:
        codes.append(kill_somewhere(tmp_path, programs, rng))
        assert codes[-1] in (0, -signal.SIGKILL)
    assert end(begin(tmp_path, programs)) == 0
    worlds.assert_same_bits(summed_up(tmp_path), undisturbed)


@pytest.mark.sweep
def test_a_full_disk_damage_a_wrong_clock_and_company_change_no_bit(
    tmp_path, programs, undisturbed
):
    rng = np.random.default_rng()
    for blocks in (0, 9, 40):  # after so many the disk is full
        assert end(begin(tmp_path, programs, full_after=blocks)) == FULL
        there = {path.name for path in tmp_path.iterdir()}
        assert len(there) > blocks or not blocks
        assert not any(name.startswith(".") for name in there)  # nothing half-written
    broken = damage(tmp_path, rng, 4)
    set_clock_back(tmp_path, rng)
    together = [begin(tmp_path, programs) for _ in range(2)]
    assert [end(process) for process in together] == [0, 0]
    worlds.assert_same_bits(summed_up(tmp_path), undisturbed)
    # One of the two has set each damaged block aside.
    bad = {path.name.split(".npz")[0] + ".npz" for path in tmp_path.glob("*.bad*")}
    assert sorted(bad) == broken
