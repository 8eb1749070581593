"""Which cases `make test` leaves out: all but one of each kind."""

import pytest


def swept(cases, *kept):
    """The cases of a parametrization; those that are not kept belong to the sweep."""
    return [
        case if case in kept else pytest.param(*_parts(case), marks=pytest.mark.sweep)
        for case in cases
    ]


def _parts(case):
    return case if isinstance(case, tuple) else (case,)
