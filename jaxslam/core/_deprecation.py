"""Names that will go: they work as before, and say once by what to replace them."""

import functools
import warnings
from collections.abc import Callable
from typing import Any, TypeVar, cast

_F = TypeVar("_F", bound=Callable[..., Any])


def deprecated(removed: str, instead: str) -> Callable[[_F], _F]:
    """A decorator of a public function or method that will be removed.

    Its first call warns, with a `DeprecationWarning` at the line of the caller; later ones do not.

    Args:
        removed: the version without it, as "1.2".
        instead: what to write in its place.
    """

    def mark(function: _F) -> _F:
        public = function.__module__.partition("._")[0]  # the package that passes the name on
        name = f"{public}.{function.__qualname__}"
        text = f"{name} goes in jaxslam {removed}: use {instead}"
        told: list[None] = []

        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            if not told:
                told.append(None)
                warnings.warn(text, DeprecationWarning, stacklevel=2)
            return function(*args, **kwargs)

        return cast("_F", call)

    return mark
