"""Lengths of a function's arguments, deduced from shapes: its own, and of its claimed Jacobian."""

import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jaxslam.verify.errors import describe_error
from jaxslam.verify.inputs.claims import Claim, as_claim, split_claim

LONGEST = 12
"""the largest length that is tried"""
MOST_UNKNOWN = 3
"""number of arguments of unknown length above which none is tried"""


class Deduced(NamedTuple):
    """What shapes tell of the lengths of arguments."""

    lengths: dict[str, int]
    """of the arguments whose length is determined"""
    error: str
    """where no lengths fit: the error at the last that were tried"""


def deduce_lengths(
    call: Callable[..., PyTree],
    claim: Claim | None,
    known: dict[str, int | None],
    rows: int | None,
) -> Deduced:
    """The lengths of arguments that the function and its claimed Jacobian leave no choice about.

    Every combination of lengths from 1 to 12 of the arguments whose length is unknown is tried. It
    fits if the function returns a vector (m,), m as the outputs say where they are named, and the
    claimed Jacobian one of: a tuple of an array (m, n_k) or None for each argument; one array
    (m, Σ n_k), by all of them side by side; one array (m, n_0), by the first. The length of an
    argument is determined if it is the same in all combinations that fit. If none fits, the
    claimed Jacobian is left out, and the report says what is wrong with its shape.

    Functions are traced, not computed, where JAX can trace them.

    Args:
        call: the function.
        claim: its claimed Jacobian, if there is one.
        known: the arguments by name, in order, with their lengths where these are known.
        rows: m, where it is known.
    """
    unknown = [name for name, length in known.items() if length is None]
    if len(unknown) > MOST_UNKNOWN:
        return Deduced({}, "")
    fits, of_function, error = [], [], ""
    for combination in itertools.product(range(1, LONGEST + 1), repeat=len(unknown)):
        tried = dict(zip(unknown, combination, strict=True))
        sizes = [tried[name] if length is None else length for name, length in known.items()]
        try:
            values = _shapes(call, sizes)
            if len(values) != 1 or len(values[0]) != 1 or rows not in (None, *values[0]):
                error = f"it returns shapes {values}, expected ({'m' if rows is None else rows},)"
                continue
            of_function.append(tried)
            if claim is not None:
                _split(claim, *values[0], list(known), sizes)
                fits.append(tried)
        except (Exception, SystemExit) as failure:
            error = describe_error(failure)
    candidates = fits or of_function
    if not candidates:
        return Deduced({}, error)
    first = candidates[0]
    same = [name for name in unknown if all(c[name] == first[name] for c in candidates)]
    return Deduced({name: first[name] for name in same}, "")


def _split(claim: Claim, rows: int, names: Sequence[str], sizes: Sequence[int]) -> None:
    """Raise unless the shapes of a claimed Jacobian are those of arguments of some lengths."""
    parts: list[bool] = []

    def arrays(*arguments: jax.Array) -> list[PyTree]:
        out = as_claim(claim(*arguments))
        whole = out if isinstance(out, tuple) else (out,)
        parts[:] = [isinstance(out, tuple), *(part is not None for part in whole)]
        return [part for part in whole if part is not None]

    shapes = iter(_shapes(arrays, sizes))
    is_tuple, *present = parts
    whole = tuple(np.empty(next(shapes)) if there else None for there in present)
    split_claim(whole if is_tuple else whole[0], rows, names, sizes)


def _shapes(call: Callable[..., PyTree], sizes: Sequence[int]) -> list[tuple[int, ...]]:
    """The shapes of what a function of vectors returns, traced if it can be, else computed."""
    try:
        traced = [jax.ShapeDtypeStruct((n,), np.float64) for n in sizes]
        out = jax.eval_shape(call, *traced)
    except (jax.errors.JAXTypeError, TypeError):
        with np.errstate(all="ignore"):
            out = call(*(0.7 + 0.1 * jnp.arange(n) for n in sizes))
    return [np.shape(leaf) for leaf in jax.tree.leaves(out)]
