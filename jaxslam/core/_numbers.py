"""Sizes of numbers: what a file may hold, the largest of a log, the quantile of a gate."""

import math
from numbers import Integral
from typing import TypeGuard

import jax
import jax.numpy as jnp
from numpy.typing import ArrayLike

from jaxslam.math._arrays import Number, as_array, is_concrete
from jaxslam.math.stats import chi2_quantile

__all__ = ["as_array", "gate_quantile", "is_concrete", "is_number", "is_whole", "largest"]


def is_number(value: object) -> TypeGuard[int | float]:
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


def gate_quantile(gate: Number | None, dof: int) -> Number | None:
    """γ, the largest d² of dof numbers within a gate: its χ² quantile; None without a gate."""
    return None if gate is None else chi2_quantile(gate, dof)
