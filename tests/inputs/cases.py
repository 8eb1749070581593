"""Cases of tests: which of them `make test` leaves out, and tables of what is refused."""

import functools
import inspect
import re

import pytest


def refused(*cases, told="", error=ValueError, escaped=False):
    """Makes a test of a call, which must fail in every case, with one line.

    A case is the call's first arguments and a pattern of the message, before which `told` stands.
    The call's other arguments are fixtures. escaped: the pattern is plain text.
    """

    def test_of(call):
        arguments = list(inspect.signature(call).parameters)
        given = arguments[: len(cases[0]) - 1]

        @pytest.mark.parametrize((*given, "reason"), cases)
        @functools.wraps(call)
        def test(*, reason, **values):
            pattern = told + (re.escape(reason) if escaped else reason)
            with pytest.raises(error, match=pattern) as caught:
                call(**values)
            assert "\n" not in str(caught.value)

        kind = inspect.Parameter.KEYWORD_ONLY
        parameters = [inspect.Parameter(name, kind) for name in (*arguments, "reason")]
        test.__signature__ = inspect.Signature(parameters)
        return test

    return test_of


def swept(cases, *kept):
    """The cases of a parametrization; those that are not kept belong to the sweep."""
    return [
        case if case in kept else pytest.param(*_parts(case), marks=pytest.mark.sweep)
        for case in cases
    ]


def _parts(case):
    return case if isinstance(case, tuple) else (case,)
