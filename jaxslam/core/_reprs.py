"""Short texts of records of arrays: kinds and shapes in place of numbers."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jaxslam.core._numbers import is_concrete

_LONGEST = 60
"""characters of a value that is no array"""


def short_repr(record: PyTree) -> str:
    """A NamedTuple of arrays as text, as Scan(z=float64[100,6,2], …); its tracers, too."""
    name, fields = type(record).__name__, record._fields
    return f"{name}({', '.join(f'{field}={text_of(getattr(record, field))}' for field in fields)})"


def text_of(value: PyTree) -> str:
    """A value as text: arrays by kind and shape, others as they are, cut to `_LONGEST`."""
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        if _is_number(value):
            return str(jax.device_get(value))
        return f"{value.dtype}[{','.join(map(str, value.shape))}]"
    if hasattr(value, "_fields"):
        return short_repr(value)
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{key!r}: {text_of(one)}' for key, one in value.items())}}}"
    if isinstance(value, tuple | list) and len(value) <= _LONGEST:
        within = ", ".join(map(text_of, value))
        return f"[{within}]" if isinstance(value, list) else f"({within})"
    text = repr(value)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"


def _is_number(value: PyTree) -> bool:
    """Whether an array is a number whose value is there."""
    array = isinstance(value, np.ndarray | np.generic | jax.Array) and is_concrete(value)
    deleted = isinstance(value, jax.Array) and array and value.is_deleted()
    return array and not deleted and value.shape == () and jnp.issubdtype(value.dtype, np.number)
