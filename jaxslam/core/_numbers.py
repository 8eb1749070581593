"""Sizes and shapes of numbers; and checks by the name of their caller, for what is no record.

Where a record has the field, its check is declared beside it (`core.validation`).
"""

import math
from numbers import Integral
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxslam.core._reprs import with_article
from jaxslam.core.validation import (
    InvalidField,
    at_least,
    covariance,
    mounting_pose,
    or_none,
    positive,
    prng_key,
    probability,
    require,
)
from jaxslam.math._arrays import Number, held_array, is_concrete
from jaxslam.math.stats import chi2_quantile

__all__ = [
    "check_array",
    "check_count",
    "check_covariance",
    "check_gate",
    "check_key",
    "check_mount",
    "check_positive",
    "check_real",
    "gate_quantile",
    "held_array",
    "is_concrete",
    "is_number",
    "is_whole",
    "largest",
    "shape_text",
]


def is_number(value: object) -> bool:
    """Whether a value read from a file is a finite number."""
    try:
        return isinstance(value, int | float) and type(value) is not bool and math.isfinite(value)
    except OverflowError:  # a whole number that no float holds
        return False


def is_whole(value: object) -> bool:
    """Whether a value is a whole number of Python or NumPy; a bool is none."""
    return isinstance(value, Integral) and not isinstance(value, bool)


def largest(*values: ArrayLike) -> float:
    """The largest size of a number of a log, by the dtype that these values are computed in.

    The fifth root of the largest number of the dtype, 4e61 (float64) or 5e7 (float32): so a filter
    can form the products of two covariances.
    """
    with jax.numpy_dtype_promotion("standard"):  # the user may have refused promotion: "strict"
        dtype = jnp.promote_types(jnp.result_type(*values), jnp.float32)
    return float(float(jnp.finfo(dtype).max) ** 0.2)


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


def check_array(
    name: str, value: ArrayLike, shape: tuple[int | str, ...], kind: type = np.generic
) -> None:
    """Raise ValueError unless an array has this shape, in which a letter is any number."""
    got = shape_text(value)
    shape_of = np.shape(value) if got.startswith("(") else ()
    if len(shape_of) != len(shape) or any(
        isinstance(n, int) and n != m for n, m in zip(shape, shape_of, strict=True)
    ):
        expected = ", ".join(map(str, shape)) + "," * (len(shape) == 1)
        raise InvalidField(name, "", f"expected shape ({expected}), got {got}")
    if not hasattr(value, "dtype"):
        raise InvalidField(name, "", f"expected an array, got {with_article(type(value).__name__)}")
    dtype = jnp.result_type(value)
    if not jnp.issubdtype(dtype, kind):
        raise InvalidField(name, "", f"expected {kind.__name__} values, got {dtype}")


def check_real(name: str, **values: Any) -> None:
    """Raise ValueError unless values are real numbers or arrays of them; a tracer is accepted."""
    for field, value in values.items():
        if not is_concrete(value):
            continue
        try:
            dtype = np.asarray(value).dtype
        except (TypeError, ValueError):  # a key; rows of unlike lengths
            dtype = np.dtype(object)
        if not any(jnp.issubdtype(dtype, kind) for kind in (np.integer, np.floating, np.bool_)):
            got = value if isinstance(value, str | tuple | list) else shape_text(value)
            raise InvalidField(name, "", f"expected real numbers as {field}, got {got!s}")


def check_positive(name: str, **values: ArrayLike) -> None:
    """Raise ValueError unless numbers are above 0 and finite; a tracer is accepted."""
    check_real(name, **values)
    for field, value in values.items():
        try:
            positive(value)
        except ValueError:
            reason = f"expected {field} above 0, got {np.asarray(value)}"
            raise InvalidField(name, "", reason) from None


def check_mount(name: str, mount: ArrayLike) -> None:
    """Raise ValueError unless mount is a finite (3,); only the shape of a tracer is checked."""
    require(name, "", mount, mounting_pose)


def check_count(name: str, value: object, least: int = 1) -> None:
    """Raise ValueError unless value is an integer >= `least` (a bool is not)."""
    require(name, "", value, at_least(least))


def check_key(name: str, key: object) -> None:
    """Raise ValueError unless key is one PRNG key; a tracer of one is accepted."""
    require(name, "", key, prng_key)


def check_gate(name: str, gate: ArrayLike | None) -> None:
    """Raise ValueError unless the gate is None, a tracer, or a probability above 0 and below 1."""
    require(name, "gate", gate, or_none(probability))


def check_covariance(name: str, cov: ArrayLike, size: int) -> None:
    """Raise ValueError unless cov is a covariance (size, size), see `validation.covariance`."""
    require(name, "", cov, covariance(size))


def gate_quantile(gate: Number | None, dof: int) -> Number | None:
    """γ, the largest d² of dof numbers within a gate: its χ² quantile; None without a gate."""
    return None if gate is None else chi2_quantile(gate, dof)
