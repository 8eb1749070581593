"""Names that are looked up: one that is unknown is told with those like it."""

import difflib
from collections.abc import Iterable
from typing import NoReturn, TypeVar

_V = TypeVar("_V")


class UnknownName(KeyError):
    """A name that is none of those known."""

    def __str__(self) -> str:
        return str(self.args[0])  # a KeyError shows it in quotes


class Named(dict[str, _V]):
    """A dictionary that tells of a name that it has not, `UnknownName`, which it has instead."""

    def __missing__(self, name: object) -> NoReturn:
        """Refuse a name."""
        known = ", ".join(self)
        raise UnknownName(f"expected one of {known}, got {name!r}{meant(name, self)}")


def meant(name: object, known: Iterable[str]) -> str:
    """The known name that may be meant, as a question in brackets; else nothing."""
    alike = difflib.get_close_matches(str(name), known, 1)
    return "".join(f" (did you mean {each}?)" for each in alike)
