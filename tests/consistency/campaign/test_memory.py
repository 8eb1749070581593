"""A long campaign takes the memory of its result, and what is NaN in it is declared."""

import os
import sys

import jax
import numpy as np
import pytest
import worlds

from jaxslam import filters
from jaxslam.consistency.campaign import monte_carlo

pytestmark = [
    pytest.mark.sweep,
    pytest.mark.skipif(sys.platform != "linux", reason="reads /proc"),
]
RUNS, BLOCK, STEADY = 30_000, 128, 4096
"""Memory is measured from `STEADY` runs on, and to and fro by 10 MB: before, programs are compiled."""


def test_memory_grows_by_no_more_than_the_result():
    world, marks = worlds.ring(100), []

    def mark(done, total):
        with open("/proc/self/statm", encoding="ascii") as file:
            resident = int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        marks.append((done, resident))

    candidates = {"reckoning": filters.DeadReckoning(world.motion, world.sensor)}
    options = {"block": BLOCK, "devices": jax.devices()[:1], "progress": mark}
    campaign = monte_carlo(world, candidates, RUNS, worlds.key(), **options)
    summary = campaign.filters["reckoning"]
    held = sum(values.nbytes for values in summary.per_run.values()) / RUNS
    done, resident = np.array([row for row in marks if row[0] > STEADY], float).T
    a_path = 100 * 3 * 8  # bytes: what a run would add if the errors of its steps were kept
    assert np.polyfit(done, resident, 1)[0] < held + a_path / 2
    assert not summary.not_finite_runs
    some = {name: np.isnan(v) for name, v in summary.per_run.items() if not np.isnan(v).all()}
    blank = {name for name, lost in some.items() if lost.any()}
    assert blank == {"noncredibility", "inclination"}  # of the first runs alone
    assert not any(some[name][: STEADY // 4].any() for name in blank)
