"""Dictionaries by name, whose errors say what there is."""

import difflib
import inspect
from collections.abc import Callable, Iterable
from typing import NoReturn, TypeVar

_V = TypeVar("_V")


class _UnknownName(KeyError):
    """A name that is none of those known."""

    def __str__(self) -> str:
        return str(self.args[0])  # a KeyError shows it in quotes


class Named(dict[str, _V]):
    """A dict whose lookup error lists the known names and the closest match."""

    def __missing__(self, name: object) -> NoReturn:
        """Refuse a name."""
        known = ", ".join(self)
        raise _UnknownName(f"expected one of {known}, got {name!r}{meant(name, self)}")


def meant(name: object, known: Iterable[str]) -> str:
    """The closest known name, as a question in brackets, or ""."""
    alike = difflib.get_close_matches(str(name), known, 1)
    return "".join(f" (did you mean {each}?)" for each in alike)


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
