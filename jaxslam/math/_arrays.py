"""Named array types for signatures, whose shapes the tests check; and arrays in one precision.

Of one pose, one landmark, one measurement; `vmap` and `scan` add leading axes.
"""

from contextlib import AbstractContextManager
from typing import TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float, PyTree
from numpy.typing import ArrayLike

_T = TypeVar("_T")

Scalar = Float[Array, ""]
Number = float | Array
"""of Python, or an array ()"""
Pose = Float[Array, "3"]
"""(x, y, θ) [m, m, rad]; θ in (-π, π] where a pose is returned"""
Point = Float[Array, "2"]
"""(x, y) [m], or (range, bearing) [m, rad] where polar"""
PoseMatrix = Float[Array, "3 3"]
"""by the coordinates of a pose: a covariance, or a Jacobian"""
PointMatrix = Float[Array, "2 2"]
PointByPose = Float[Array, "2 3"]

Control = Float[Array, "U"]
ProcessNoise = Float[Array, "W"]
ProcessNoiseCov = Float[Array, "W W"]
StepJacobians = tuple[PoseMatrix, Float[Array, "3 U"], Float[Array, "3 W"]]
"""∂pose'/∂(pose, u, w)"""

Landmark = Float[Array, "L"]
Measurement = Float[Array, "Z"]
Unmeasured = Float[Array, "K"]
"""landmark parameters that the measurement does not determine"""
ObserveJacobians = tuple[Float[Array, "Z 3"], Float[Array, "Z L"]]
"""∂z/∂(pose, l)"""
InvertJacobians = tuple[Float[Array, "L 3"], Float[Array, "L Z"], Float[Array, "L K"]]
"""∂l/∂(pose, z, s)"""


def is_concrete(*values: object) -> bool:
    """Whether no leaf of the values is a tracer, whose number is not known."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values))


def as_array(values: ArrayLike) -> ArrayLike:
    """An array unchanged; numbers in lists or tuples as an array of float64 on the host.

    Raises ValueError on what is no real number.
    """
    if hasattr(values, "dtype"):
        return values
    if not is_concrete(values):
        return jnp.asarray(values)
    try:
        # NumPy, since jnp.asarray would round to float32 unless the user has 64-bit types on.
        return np.asarray(values, np.float64)
    except TypeError:
        raise ValueError(f"expected real numbers, got {values!r:.60}") from None


def in_dtype(tree: _T, dtype: DTypeLike) -> _T:
    """The tree with its real numbers in one precision; arrays of it stay as they are."""

    def convert(leaf: PyTree) -> PyTree:
        kind = jnp.result_type(leaf)
        differs = jnp.issubdtype(kind, jnp.floating) and kind != dtype
        return jnp.asarray(leaf, dtype) if differs else leaf

    return cast(_T, jax.tree.map(convert, tree))


def float64() -> AbstractContextManager[object]:
    """A block in which JAX has 64-bit types, in this thread."""
    context: AbstractContextManager[object] = jax.enable_x64(True)
    return context
