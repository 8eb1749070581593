"""Shapes in signatures, checked while the suite runs: what jaxtyping's import hook decorates with.

The hook decorates every function, most of which no array enters by name, and `jaxtyped` binds the
arguments of each call and makes two functions of each definition: a third of the time of a trace.
`checked` stands in its place. It leaves functions without such annotations as they are, and looks
at arrays where the annotation of an argument or a result is a jaxtyping array, an optional one or a
tuple of such. Whether a value is an array at all is mypy's to say.
"""

import functools
import inspect
import types
import typing

import jax
import jaxtyping
import numpy as np

IN_ORDER = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
ONE_SCOPE = jaxtyping.jaxtyped("context")
"""Within it a name stands for one size; scopes may be nested."""


def install(package):
    """Check the functions of a package, and the dataclasses when they are made, from its import on."""
    jaxtyping.jaxtyped = lambda typechecker: checked
    jaxtyping.install_import_hook(package, None)


def checked(function):
    """The function, which raises TypeError on an array that is not as its annotation says."""
    if inspect.isclass(function):
        if "__dataclass_fields__" in vars(function):
            function.__init__ = checked(function.__init__)
        return function
    if not inspect.isfunction(function):
        return function
    hints = {name: hint for name, hint in function.__annotations__.items() if _holds_arrays(hint)}
    if not hints:
        return function
    returned = hints.pop("return", None)
    given = [
        (i if parameter.kind in IN_ORDER else np.inf, name, hints[name])
        for i, (name, parameter) in enumerate(inspect.signature(function).parameters.items())
        if name in hints
    ]

    known = set()
    """Shapes that fit: of the arguments, and of the arguments with the result."""

    def check(values):
        for value, (_, name, hint) in zip(values, given, strict=True):
            if value is not None and not _fits(value, hint):
                raise TypeError(f"{function.__qualname__}: {name} is no {hint}: {_told(value)}")

    @functools.wraps(function)
    def call(*args, **kwargs):
        values = [args[i] if i < len(args) else kwargs.get(name) for i, name, _ in given]
        shapes = tuple(map(_shape, values))
        if shapes not in known:
            with ONE_SCOPE:
                check(values)
            known.add(shapes)
        found = function(*args, **kwargs)
        if returned is not None and (shapes, _shape(found)) not in known:
            with ONE_SCOPE:
                check(values)
                if not _fits(found, returned):
                    told = f"returns no {returned}: {_told(found)}"
                    raise TypeError(f"{function.__qualname__}: {told}")
            known.add((shapes, _shape(found)))
        return found

    return call


def _shape(value):
    """All that `_fits` looks at; the same shapes are looked at once."""
    if isinstance(value, tuple):
        return tuple(map(_shape, value))
    return type(value), getattr(value, "shape", None), getattr(value, "dtype", None)


def _is_array(hint):
    return isinstance(hint, type) and issubclass(hint, jaxtyping.AbstractArray)


@functools.cache
def _holds_arrays(hint):
    parts = (part for part in typing.get_args(hint) if not isinstance(part, list))  # of Callable
    return _is_array(hint) or any(map(_holds_arrays, parts))


@functools.cache
def _in_numpy(hint):
    """The same shape and kind, of an array of NumPy."""
    return hint.dtype[np.ndarray, hint.dim_str]


def _fits(value, hint):
    if _is_array(hint):
        if isinstance(value, np.ndarray | np.generic):  # where JAX takes either
            return isinstance(np.asarray(value), _in_numpy(hint))
        return not isinstance(value, jax.Array) or isinstance(value, hint)
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
