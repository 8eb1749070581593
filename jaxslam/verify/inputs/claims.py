"""What a hand-derived Jacobian may return, and how it is split by the function's arguments."""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from numpy.typing import ArrayLike

Claim: TypeAlias = Callable[..., ArrayLike | Sequence[ArrayLike | None]]
"""A hand-derived Jacobian: arguments -> one array, or one array or None for each argument."""


def as_claim(claim: PyTree) -> PyTree:
    """A claimed Jacobian as one array or a tuple of arrays; a list of rows is one array."""
    if claim is None:
        raise ValueError("returns None: is a `return` missing?")
    if isinstance(claim, list):
        nested = all(isinstance(row, list | tuple) for row in claim)
        return jnp.asarray(claim) if nested else tuple(claim)
    return claim


def split_claim(
    claim: PyTree, rows: int, names: Sequence[str], sizes: Sequence[int]
) -> list[PyTree]:
    """A claimed Jacobian split by argument, None where there is no claim.

    Args:
        claim: as from `as_claim`: arrays, or their shapes, with any number of leading axes.
        rows: m, the length of the function's value.
        names, sizes: of its arguments, the names and the lengths n_k.
    Returns:
        One (m, n_k) or None for each argument: the parts of a tuple, the columns of one array
        (m, Σ n_k), or one array (m, n_0) by the first argument.
    Raises:
        ValueError: on any other shape.
    """
    if not isinstance(claim, tuple | list):
        total = sum(sizes)
        if np.shape(claim)[-2:] == (rows, total) and len(sizes) > 1:
            if isinstance(claim, jax.ShapeDtypeStruct):
                return [jax.ShapeDtypeStruct((rows, n), claim.dtype) for n in sizes]
            edges = [0, *np.cumsum(sizes).tolist()]
            return [claim[..., a:b] for a, b in pairwise(edges)]
        claim = (claim, *(None for _ in sizes[1:]))
    if len(claim) != len(sizes):
        raise ValueError(
            f"returns {len(claim)} Jacobians where the function has {len(sizes)} arguments"
        )
    for part, size, name in zip(claim, sizes, names, strict=True):
        if part is not None and np.shape(part)[-2:] != (rows, size):
            raise ValueError(
                f"has shape {np.shape(part)[-2:]} by {name}; expected ({rows}, {size})"
            )
    return list(claim)
