"""Shapes in signatures, checked while the suite runs: a type checker for jaxtyping's import hook.

It looks at arrays where the annotation of an argument or a result is a jaxtyping array, an optional
one or a tuple of such. Whether a value is an array at all is mypy's to say.
"""

import functools
import inspect
import types
import typing

import jax
import jaxtyping
import numpy as np


def checked(function):
    """The function, which raises TypeError on an array that is not as its annotation says."""
    hints = {
        name: hint
        for name, hint in getattr(function, "__annotations__", {}).items()
        if _holds_arrays(hint)
    }
    if not hints:
        return function
    returned = hints.pop("return", None)
    signature = inspect.signature(function)

    @functools.wraps(function)
    def call(*args, **kwargs):
        given = signature.bind(*args, **kwargs).arguments
        for name, hint in hints.items():
            if name in given and not _fits(given[name], hint):
                raise TypeError(
                    f"{function.__qualname__}: {name} is no {hint}: {_told(given[name])}"
                )
        found = function(*args, **kwargs)
        if returned is not None and not _fits(found, returned):
            raise TypeError(f"{function.__qualname__}: returns no {returned}: {_told(found)}")
        return found

    return call


def _is_array(hint):
    return isinstance(hint, type) and issubclass(hint, jaxtyping.AbstractArray)


def _holds_arrays(hint):
    return _is_array(hint) or any(map(_holds_arrays, typing.get_args(hint)))


def _fits(value, hint):
    if _is_array(hint):
        if isinstance(value, np.ndarray | np.generic):  # where JAX takes either
            hint = hint.dtype[np.ndarray, hint.dim_str]
            value = np.asarray(value)
        return not isinstance(value, jax.Array | np.ndarray) or isinstance(value, hint)
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, part) for part in parts if _holds_arrays(part))
    if origin is tuple and isinstance(value, tuple) and len(parts) == len(value):
        pairs = zip(value, parts, strict=True)
        return all(_fits(each, part) for each, part in pairs if _holds_arrays(part))
    return True


def _told(value):
    if isinstance(value, tuple):
        return f"({', '.join(map(_told, value))})"
    return f"{getattr(value, 'dtype', type(value).__name__)}{getattr(value, 'shape', '')}"
