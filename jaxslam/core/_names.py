"""Dictionaries by name, whose errors say what there is."""

import difflib
import inspect
from collections.abc import Callable, Iterable
from typing import NoReturn, TypeVar

_V = TypeVar("_V")


class _UnknownName(KeyError):
    """A name that a dict does not have."""

    def __str__(self) -> str:
        return str(self.args[0])  # a KeyError shows it in quotes


class Named(dict[str, _V]):
    """A dict whose lookup error lists its names and the closest match."""

    def __missing__(self, name: object) -> NoReturn:
        """Refuse a name."""
        names = ", ".join(self)
        raise _UnknownName(f"expected one of {names}, got {name!r}{meant(name, self)}")


def meant(name: object, names: Iterable[str]) -> str:
    """The closest of several names, as a question in brackets, or ""."""
    closest = difflib.get_close_matches(str(name), names, 1)
    return "".join(f" (did you mean {match}?)" for match in closest)


def unfit_signature(function: Callable[..., object], count: int) -> str | None:
    """The parameters of a function that does not take `count` arguments; None of one that does."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # a builtin has none
        return None
    try:
        signature.bind(*[None] * count)
    except TypeError:
        return f"({', '.join(signature.parameters)})"
    return None
