"""A plain function as a claim; and what a hand-derived Jacobian may return, split by argument."""

import contextlib
import inspect
import operator
from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate, pairwise

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PyTree
from numpy.typing import ArrayLike

from jaxslam.core.claims import Argument, Claim, Jacobian
from jaxslam.core.protocols import POSE
from jaxslam.core.validation import InvalidField, refusals_of

NAMED = {"pose": POSE, "frame": POSE, "landmark": POSE[:2], "l": POSE[:2], "point": POSE[:2]}
"""Entries of an argument by its name."""

_PERIODS = {"[rad]": 2 * np.pi, "[deg]": 360.0, "[°]": 360.0}
"""A whole turn by its unit."""


def periods(names: Sequence[str]) -> Float[np.ndarray, "m"]:
    """The periods of quantities by their units: 2π of [rad], 360 of [deg], inf of all else."""
    return np.array([_PERIODS.get(name.split(" ")[-1], np.inf) for name in names])


def at_state(claim: Claim, state: Sequence[ArrayLike]) -> str:
    """The arguments at a state as text, as in "pose = (1, 2, 0.5), u = (0, 1)"."""
    pairs = zip(claim.arguments, state, strict=True)
    return ", ".join(
        f"{argument.name} = ({', '.join(f'{v:.6g}' for v in np.asarray(row))})"
        for argument, row in pairs
    )


def split_jacobian(value: PyTree, claim: Claim) -> list[PyTree]:
    """What a claim's hand-derived Jacobian returns as one (m, n_k) or None for each argument.

    These are the parts of a tuple, the columns of one array (m, Σ n_k), or one array (m, n_0) by
    the first argument; a list of rows is one array. Raises ValueError on any other shape.
    """
    rows, sizes = len(claim.outputs), [len(argument.entries) for argument in claim.arguments]
    if value is None:
        raise ValueError("returns None: is a `return` missing?")
    if isinstance(value, list):
        nested = all(isinstance(row, list | tuple) for row in value)
        value = jnp.asarray(value) if nested else tuple(value)
    if not isinstance(value, tuple):
        if np.shape(value) == (rows, sum(sizes)) and len(sizes) > 1:
            return [value[:, a:b] for a, b in pairwise(accumulate(sizes, initial=0))]
        value = (value, *(None for _ in sizes[1:]))
    if len(value) != len(sizes):
        raise ValueError(
            f"returns {len(value)} Jacobians where the function has {len(sizes)} arguments"
        )
    for part, size, argument in zip(value, sizes, claim.arguments, strict=True):
        if part is not None and np.shape(part) != (rows, size):
            shape = np.shape(part)
            raise ValueError(f"has shape {shape} by {argument.name}; expected ({rows}, {size})")
    return list(value)


def function_claim(
    call: Callable[..., jax.Array],
    jacobian: Jacobian | None,
    arguments: Mapping[str, Sequence[str] | int] | None = None,
    outputs: Sequence[str] | None = None,
    name: str | None = None,
    states: Sequence[ArrayLike] | None = None,
) -> Claim:
    """The claim of a function of vectors, whose arguments have the names of its parameters.

    Lengths that neither `arguments` nor a parameter's name states are taken from the states.
    Raises ValueError where the length of an argument is not known.
    """
    name = name or str(getattr(call, "__name__", type(call).__name__))
    with refusals_of(name):
        if arguments is not None and not isinstance(arguments, Mapping):
            raise InvalidField("arguments", f"expected {{name: entries}}, got {arguments!r}")
        if isinstance(outputs, str):
            raise InvalidField("outputs", f"expected a tuple of names, got {outputs!r}")
        parameters = _parameters(call, arguments or {})
        if not parameters:
            raise InvalidField("", "expected a function with a parameter to differentiate by")
        if unknown := [key for key in arguments or {} if key not in parameters]:
            reason = f"expected those of {', '.join(parameters)}, got {', '.join(unknown)}"
            raise InvalidField("arguments", reason)
        shapes = [np.shape(table) for table in (() if states is None else states)]
        lengths: dict[str, Sequence[str] | int] = {}
        if len(shapes) == len(parameters) and all(len(shape) == 2 for shape in shapes):
            lengths = {p: shape[1] for p, shape in zip(parameters, shapes, strict=True)}
        lengths |= NAMED | dict(arguments or {})
        if missing := [p for p in parameters if p not in lengths]:
            line = ", ".join(f'"{p}": ("v [m/s]", "omega [rad/s]")' for p in missing)
            where = "arguments={%s} in Python; in a file define a function, which has a name"
            if name.isidentifier():
                where = f"{name}_arguments = {{%s}} in the file, or arguments= in Python"
            reason = (
                f"the length of {', '.join(map(repr, missing))} is not known. Name the entries, "
                f"each with its unit: {where % line}"
            )
            raise InvalidField("", reason)
        listed = tuple(Argument(p, _entries(p, lengths[p])) for p in parameters)
        return Claim(name, call, listed, tuple(outputs or ()), jacobian)


def _parameters(call: Callable[..., object], listed: Mapping[str, object]) -> list[str]:
    """The names of a function's required parameters, or those listed where Python has none."""
    try:
        signature = inspect.signature(call)
    except (TypeError, ValueError):
        if listed:
            return list(listed)
        raise
    return [
        p.name
        for p in signature.parameters.values()
        if p.default is p.empty and p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)
    ]


def _entries(parameter: str, entries: Sequence[str] | int) -> tuple[str, ...]:
    """The names of an argument's entries, which may be given by their number."""
    with contextlib.suppress(TypeError):
        count = operator.index(entries)  # type: ignore[arg-type]  # also a whole number of NumPy
        if count < 0:
            raise InvalidField(parameter, f"expected a number of entries, got {count}")
        return tuple(f"{parameter}[{k}]" for k in range(count))
    names = tuple(entries) if isinstance(entries, list | tuple) else ()
    if not all(isinstance(entry, str) for entry in names) or names == () != entries:
        raise InvalidField(parameter, f"expected a tuple of names or their number, got {entries!r}")
    return names
