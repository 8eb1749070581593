"""A deprecated name works, warns once at its caller, and says when it goes and what replaces it."""

import warnings

import pytest

from jaxslam.core._deprecation import deprecated


def test_a_deprecated_function_warns_once_where_it_is_called():
    @deprecated("1.2", "after")
    def before(x, *, by=1):
        """The sum."""
        return x + by

    with pytest.warns(DeprecationWarning, match=r"before goes in jaxslam 1\.2: use after") as seen:
        assert before(1, by=2) == 3
    assert seen[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert before(2) == 3
    assert before.__doc__ == "The sum." and before.__name__ == "before"


def test_each_name_has_its_own_warning():
    for name in "ab":
        with pytest.warns(DeprecationWarning, match=f"use {name}"):
            deprecated("1.1", name)(lambda: None)()
