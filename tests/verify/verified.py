"""What a verification found, by name; and how a suite of them is compiled."""

import pytest

from jaxslam.math import _xla as xla


@pytest.fixture(autouse=True, scope="module")
def quickly():
    """What `quick_jit` compiles, compiled as all of the suite is: its own options ask for more, and
    take a quarter longer."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(xla, "quick_options", lambda platform: None)
        yield


def by_name(report, name):
    (check,) = [c for c in report.checks if c.name == name]
    return check


def failed(report):
    names = [c.name for c in report.checks if not c.passed]
    return sorted(names + [f.name for f in report.findings if not f.passed])
