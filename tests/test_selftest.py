"""`python -m jaxslam.selftest`: a line a check, and an exit status that tells."""

import re

import numpy as np
import pytest

from jaxslam import selftest
from jaxslam.selftest import Check


@pytest.mark.sweep
def test_every_check_passes_and_prints_a_line(capsys):
    assert selftest.main() == 0
    first, *lines, last = capsys.readouterr().out.splitlines()
    assert first.startswith("python 3.") and "jax " in first
    number = r" +\d\S* +in \[\S+, \S+\]"
    assert all(re.fullmatch(rf"ok {{6}}\S.*{number}", line) for line in lines)
    assert {"Kalman filter by NumPy" in line for line in lines[:4]} == {True}
    assert len(lines) == 4 + 5  # the suite has four devices
    assert last.startswith("0 failed, ")


@pytest.mark.parametrize("found", [2.0, -1.0, np.nan, np.inf])
def test_a_failed_check_is_told(found, capsys, monkeypatch):
    monkeypatch.setattr(
        selftest, "checks", lambda: iter([Check("one", 0.5, 1.0), Check("two", found, 1.0)])
    )
    assert selftest.main() == 1
    _, good, bad, last = capsys.readouterr().out.splitlines()
    assert good.startswith("ok      one ") and bad.startswith("FAILED  two ")
    assert last.startswith("1 failed, ")


def test_a_filter_that_is_off_is_found(monkeypatch):
    """Half the noise of the sensor in the Kalman filter is no rounding."""
    monkeypatch.setitem(selftest._SIGMA, "sensor", 0.1)
    worlds = selftest._linear_world()
    monkeypatch.setitem(selftest._SIGMA, "sensor", 0.2)
    monkeypatch.setattr(selftest, "_linear_world", lambda: worlds)
    first = next(selftest.checks())
    assert not first.passed
