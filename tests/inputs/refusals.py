"""What is refused: a table of bad arguments, each with a pattern of its message, as a test."""

import functools
import inspect

import pytest


def refused(*cases, told="", error=ValueError):
    """Makes a test of a call, which must fail in every case, with one line.

    A case is the call's first arguments and a pattern of the message, before which `told` stands.
    The call's other arguments are fixtures.
    """

    def test_of(call):
        arguments = list(inspect.signature(call).parameters)
        given = arguments[: len(cases[0]) - 1]

        @pytest.mark.parametrize((*given, "reason"), cases)
        @functools.wraps(call)
        def test(*, reason, **values):
            with pytest.raises(error, match=told + reason) as caught:
                call(**values)
            assert "\n" not in str(caught.value)

        kind = inspect.Parameter.KEYWORD_ONLY
        parameters = [inspect.Parameter(name, kind) for name in (*arguments, "reason")]
        test.__signature__ = inspect.Signature(parameters)
        return test

    return test_of
