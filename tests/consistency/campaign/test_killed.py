"""Whatever ends a campaign, what is resumed is to the bit what would have been."""

import signal
import sys

import numpy as np
import pytest
import worlds

from jaxslam import store

if sys.platform != "linux":
    pytest.skip("needs forkserver, SIGKILL and limits of resources", allow_module_level=True)
import killed


@pytest.fixture(scope="module")
def programs(tmp_path_factory):
    return tmp_path_factory.mktemp("programs")


@pytest.fixture(scope="module")
def undisturbed(programs, tmp_path_factory):
    folder = tmp_path_factory.mktemp("undisturbed")
    assert killed.end(killed.begin(folder, programs)) == 0
    return summed_up(folder)


def summed_up(folder):
    """The campaign in a folder, all of whose blocks are there, and valid."""
    made = store.resume(folder)
    assert made.done() == killed.RUNS
    found = killed.campaign(keep=made)
    assert found.compile_seconds == 0  # nothing was left to run
    assert made.set_aside == []
    return found


def test_ten_kills_anywhere_change_no_bit(tmp_path, programs, undisturbed):
    rng, codes = np.random.default_rng(), []
    while codes.count(-signal.SIGKILL) < 10:
        codes.append(killed.kill_somewhere(tmp_path, programs, rng))
        assert codes[-1] in (0, -signal.SIGKILL)
    assert killed.end(killed.begin(tmp_path, programs)) == 0
    worlds.assert_same_bits(summed_up(tmp_path), undisturbed)


def test_a_full_disk_damage_a_wrong_clock_and_company_change_no_bit(
    tmp_path, programs, undisturbed
):
    rng = np.random.default_rng()
    for blocks in (0, 9, 40):  # after so many the disk is full
        assert killed.end(killed.begin(tmp_path, programs, full_after=blocks)) == killed.FULL
        there = {path.name for path in tmp_path.iterdir()}
        assert len(there) > blocks or not blocks
        assert not any(name.startswith(".") for name in there)  # nothing half-written
    broken = killed.damage(tmp_path, rng, 4)
    killed.set_clock_back(tmp_path, rng)
    together = [killed.begin(tmp_path, programs) for _ in range(2)]
    assert [killed.end(process) for process in together] == [0, 0]
    worlds.assert_same_bits(summed_up(tmp_path), undisturbed)
    # One of the two has set each damaged block aside.
    bad = {path.name.split(".npz")[0] + ".npz" for path in tmp_path.glob("*.bad*")}
    assert sorted(bad) == broken
