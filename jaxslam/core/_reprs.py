"""Short texts: of records of arrays, by kinds and shapes in place of numbers; of what was got."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from jaxslam.math._arrays import is_concrete

_LONGEST = 60
"""characters of a value that is no array"""


def short_repr(record: PyTree) -> str:
    """A NamedTuple of arrays as text, as Scan(z=float64[100,6,2], …); its tracers, too."""
    name, fields = type(record).__name__, record._fields
    return f"{name}({', '.join(f'{field}={text_of(getattr(record, field))}' for field in fields)})"


def text_of(value: PyTree) -> str:
    """A value as text: arrays by kind and shape, others as they are, cut to `_LONGEST`."""
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        is_array = isinstance(value, np.ndarray | np.generic | jax.Array)
        is_there = is_array and is_concrete(value)
        if is_there and isinstance(value, jax.Array):
            is_there = not value.is_deleted()
        if is_there and value.shape == () and jnp.issubdtype(value.dtype, np.number):
            return str(jax.device_get(value))
        return f"{value.dtype}[{','.join(map(str, value.shape))}]"
    if hasattr(value, "_fields"):
        return short_repr(value)
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{key!r}: {text_of(entry)}' for key, entry in value.items())}}}"
    if isinstance(value, tuple | list) and len(value) <= _LONGEST:
        within = ", ".join(map(text_of, value))
        return f"[{within}]" if isinstance(value, list) else f"({within})"
    text = repr(value)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"


def describe(value: object) -> str:
    """A value in few words: a number or text as it is, the shape of an array, a kind."""
    if value is None or isinstance(value, str | int | float | complex):
        return repr(value)
    if isinstance(value, type):
        return f"the class {value.__name__}: call it, {value.__name__}(…)"
    shape = getattr(value, "shape", None)
    if shape == () and is_concrete(value) and real_array(value) is not None:
        return str(value)
    if isinstance(shape, tuple):
        dtype = getattr(value, "dtype", None)
        key = dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key)
        return f"{'PRNG keys' if key else 'an array'} of shape {shape}"
    if type(value) in (list, tuple) and (array := real_array(value)) is not None:
        return f"{with_article(type(value).__name__)} of shape {array.shape}"
    return with_article(type(value).__name__)


def shape_text(value: ArrayLike) -> str:
    """The shape of an array, or the type of anything else, for an error message."""
    try:
        shape = np.shape(value)
    except ValueError:
        return "rows of unlike lengths"
    if shape == () and not hasattr(value, "shape"):
        plain = value is None or isinstance(value, str | int | float | complex)
        return repr(value) if plain else with_article(type(value).__name__)
    return str(shape)


def with_article(noun: str) -> str:
    """The noun with its article: "an EkfSlam", "a Unicycle", "an Unscented"; "Points" has none."""
    if noun.endswith("s") and not noun.endswith(("ss", "us", "is")):
        return noun
    vowel = noun[:1] in "AEIOaeio" or (noun[:2] in ("Un", "un") and noun[2:3] != "i")
    return f"{'an' if vowel or noun == 'ndarray' else 'a'} {noun}"


def real_array(value: Any) -> Any:
    """Real numbers as an array of their dtype; None of anything else."""
    try:
        if not hasattr(value, "dtype"):
            value = np.asarray(value) if is_concrete(value) else jnp.asarray(value)
    except (TypeError, ValueError):  # rows of unlike lengths, tracers beside text
        return None
    real = any(jnp.issubdtype(value.dtype, kind) for kind in (np.integer, np.floating))
    return value if real else None
