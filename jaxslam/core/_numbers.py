"""Checks of numbers: counts, keys, gates, covariances."""

import math
import warnings
from numbers import Integral
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxslam.core._units import TURN
from jaxslam.math._arrays import Number
from jaxslam.math._definite import asymmetric, indefinite
from jaxslam.math.stats import chi2_quantile


def is_concrete(*values: object) -> bool:
    """Whether the values are concrete, i.e. no leaf is a tracer."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values))


def is_number(value: object) -> bool:
    """Whether a value read from a file is a finite number."""
    try:
        return isinstance(value, int | float) and type(value) is not bool and math.isfinite(value)
    except OverflowError:  # a whole number that no float holds
        return False


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
        return repr(value) if plain else f"a {type(value).__name__}"
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
        raise ValueError(f"{name}: expected shape ({expected}), got {got}")
    if not hasattr(value, "dtype"):
        raise ValueError(f"{name}: expected an array, got a {type(value).__name__}")
    dtype = jnp.result_type(value)
    if not jnp.issubdtype(dtype, kind):
        raise ValueError(f"{name}: expected {kind.__name__} values, got {dtype}")


def check_real(name: str, **values: Any) -> None:
    """Raise ValueError unless values are real numbers or arrays of them; a tracer is accepted."""
    for what, value in values.items():
        if not is_concrete(value):
            continue
        try:
            dtype = np.asarray(value).dtype
        except (TypeError, ValueError):  # a key; rows of unlike lengths
            dtype = np.dtype(object)
        if not any(jnp.issubdtype(dtype, kind) for kind in (np.integer, np.floating, np.bool_)):
            got = value if isinstance(value, str | tuple | list) else shape_text(value)
            raise ValueError(f"{name}: expected real numbers as {what}, got {got!s}")


def check_positive(name: str, **values: ArrayLike) -> None:
    """Raise ValueError unless numbers are above 0 and finite; a tracer is accepted."""
    check_real(name, **values)
    for what, value in values.items():
        if is_concrete(value) and not (np.shape(value) == () and 0 < np.asarray(value) < np.inf):
            raise ValueError(f"{name}: expected {what} above 0, got {np.asarray(value)}")


def check_mount(name: str, mount: ArrayLike) -> None:
    """Raise ValueError unless mount is a finite (3,); only the shape of a tracer is checked.

    Warns of a heading beyond 2π, which may be in degrees.
    """
    got = shape_text(mount if is_concrete(mount) else jnp.asarray(mount))
    if got != "(3,)":
        raise ValueError(f"{name}: expected a mounting pose of shape (3,), got {got}")
    check_real(name, mount=mount)
    if is_concrete(mount) and not np.all(np.isfinite(np.asarray(mount))):
        raise ValueError(f"{name}: the mounting pose is not finite")
    if is_concrete(mount) and abs(heading := float(np.asarray(mount)[2])) > TURN:
        warnings.warn(
            f"{name}: the heading of the mounting pose, {heading:g} rad, is beyond 2π: is it in "
            "degrees?",
            stacklevel=4,  # through __post_init__ and the __init__ of the record
        )


def held_array(values: ArrayLike) -> ArrayLike:
    """An array unchanged; numbers in lists or tuples as an array in float64."""
    if hasattr(values, "dtype"):
        return values
    if not is_concrete(values):
        return jnp.asarray(values)
    return np.asarray(values, np.float64)


def check_count(name: str, value: object, least: int = 1) -> None:
    """Raise ValueError unless value is an integer >= `least` (a bool is not)."""
    if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
        raise ValueError(f"{name}: expected an integer >= {least}, got {value!r}")


def check_key(name: str, key: object) -> None:
    """Raise ValueError unless key is one PRNG key: of `jax.random.key`, or the raw numbers of one.

    A tracer of one is accepted.
    """
    dtype, shape = getattr(key, "dtype", None), getattr(key, "shape", None)
    if dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key):
        if shape != ():
            raise ValueError(f"{name}: expected one PRNG key, got keys of shape {shape}")
    elif dtype != np.uint32 or shape is None or len(shape) != 1:
        shown = repr(key) if dtype is None else f"an array of {dtype} of shape {shape}"
        raise ValueError(f"{name}: expected a PRNG key, as jax.random.key(0), got {shown}")


def check_gate(name: str, gate: ArrayLike | None) -> None:
    """Raise ValueError unless the gate is None, a tracer, or a probability above 0 and below 1."""
    if gate is None or not is_concrete(gate):
        return
    check_real(name, gate=gate)
    value = np.asarray(gate, np.float64)
    if value.shape == () and 0 < value < 1:
        return
    hint = ""
    if value.shape == () and value >= 1:
        tail = math.exp(-float(value) / 2)
        hint = " (None for no gate)"
        if value > 1 and tail > 1e-12:  # d² is meant
            p = f"{1 - tail:.{1 - math.floor(math.log10(tail))}f}".rstrip("0")
            hint = f" (the χ² quantile {value:g} of 2 degrees of freedom is that of {p})"
    raise ValueError(
        f"{name}: expected a probability above 0 and below 1 as gate, as 0.999, got {gate}{hint}"
    )


def gate_quantile(gate: Number | None, dof: int) -> Number | None:
    """γ, the largest d² of dof numbers within a gate: its χ² quantile; None without a gate."""
    return None if gate is None else chi2_quantile(gate, dof)


def check_covariance(name: str, cov: ArrayLike, size: int) -> None:
    """Raise ValueError unless cov is real, finite, symmetric, positive semi-definite (size, size).

    Values are checked only where they are concrete; a tracer is checked for its shape alone.
    """
    got = shape_text(cov)
    if got != str((size, size)):
        raise ValueError(f"{name}: expected a covariance of shape ({size}, {size}), got {got}")
    if not is_concrete(cov):
        return
    values = np.asarray(cov)
    if not np.issubdtype(values.dtype, np.number) or np.iscomplexobj(values):
        raise ValueError(f"{name}: expected real numbers, got dtype {values.dtype}")
    if not np.issubdtype(values.dtype, np.floating):
        values = values.astype(np.float64)
    if not np.all(np.isfinite(values)):
        raise ValueError(f"{name}: the covariance has a NaN or an infinity")
    # Numbers are often written with six digits.
    if asymmetric(values, 1e-6):
        raise ValueError(f"{name}: the covariance is not symmetric")
    if indefinite(values, 1e-6):
        smallest = np.linalg.eigvalsh(values.astype(np.float64))[0]
        why = "negative variance" if np.diagonal(values).min() < 0 else f"eigenvalue {smallest:.3g}"
        raise ValueError(f"{name}: the covariance is not positive semi-definite ({why})")


def check_alpha(name: str, alpha: ArrayLike, count: int) -> None:
    """Raise ValueError unless alpha, of a motion noise, holds `count` finite real numbers >= 0.

    Values are checked only where they are concrete; a tracer is checked for its shape alone.
    """
    shape = np.shape(alpha) if is_concrete(alpha) else jnp.asarray(alpha).shape
    if shape != (count,):
        raise ValueError(f"{name}: expected alpha of shape ({count},), got {shape}")
    if not is_concrete(alpha):
        return
    values = np.asarray(alpha)
    if not np.issubdtype(values.dtype, np.number) or np.iscomplexobj(values):
        raise ValueError(f"{name}: expected alpha of real numbers, got dtype {values.dtype}")
    if not np.all(np.isfinite(values)) or np.any(values < 0):
        raise ValueError(f"{name}: expected alpha finite and not negative, got {values}")
