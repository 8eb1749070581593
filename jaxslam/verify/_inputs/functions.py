"""Functions to verify, with names and units of their arguments and outputs.

And what a hand-derived Jacobian may return, split by the function's arguments.
"""

import contextlib
import copy
import inspect
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PyTree
from numpy.typing import ArrayLike

from jaxslam.core._names import unfit_signature
from jaxslam.core._record import set_field
from jaxslam.core.protocols import POSE, Motion, Sensor
from jaxslam.core.validation import InvalidField, refusals_of
from jaxslam.graphs import Factor

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
    """A claimed Jacobian split by argument, None without a claim.

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


_POINT = ("x [m]", "y [m]")
_GLOSSARY = {
    "pose": POSE,
    "frame": POSE,
    "landmark": _POINT,
    "l": _POINT,
    "point": _POINT,
}
"""Default entries of an argument by its name."""

NAMED = tuple(_GLOSSARY)
"""Names of arguments whose entries are known."""

_PERIODS = {"[rad]": 2 * np.pi, "[deg]": 360.0, "[°]": 360.0}
"""A whole turn by its unit."""


@dataclass(frozen=True)
class Argument:
    """An argument of a function, with the names and units of its entries."""

    name: str
    entries: tuple[str, ...]
    scale: float = 1.0
    """factor of its random values; noise is small"""


@dataclass(frozen=True)
class Function:
    """A function of vectors with its hand-derived Jacobians."""

    name: str
    call: Callable[..., jax.Array]
    arguments: tuple[Argument, ...]
    outputs: tuple[str, ...]
    hand: Claim | None = None
    """arguments -> a tuple of a Jacobian or None for each argument, or one array: by the first
    argument, or by all of them side by side"""


def at_state(function: Function, state: Sequence[ArrayLike]) -> str:
    """The arguments at a state as text, as in "pose = (1, 2, 0.5), u = (0, 1)"."""
    pairs = zip(function.arguments, state, strict=True)
    return ", ".join(
        f"{argument.name} = ({', '.join(f'{v:.6g}' for v in np.asarray(row))})"
        for argument, row in pairs
    )


def periods(names: Sequence[str]) -> Float[np.ndarray, "m"]:
    """The periods of quantities by their units: 2π of [rad], 360 of [deg], inf of all else."""
    return np.array([_PERIODS.get(name.split(" ")[-1], np.inf) for name in names])


def motion_functions(motion: Motion) -> tuple[Function]:
    """The function of a motion model: `step` by pose, control and noise."""
    arguments = (
        Argument("pose", motion.state),
        Argument("control", motion.controls),
        Argument("noise", motion.noises, scale=0.1),
    )
    return (Function("step", motion.step, arguments, motion.state, motion.jacobians),)


def with_signature_errors(model: Motion | Sensor) -> Motion | Sensor:
    """The model, with methods of a wrong signature replaced by methods that raise its error."""
    names = (
        {"step": "pose, u, w"}
        if isinstance(model, Motion)
        else {"observe": "pose, l", "invert": "pose, z, s", "residual": "z, z_hat"}
    )

    def refusing(why: str) -> Callable[..., jax.Array]:
        def refuse(*_: object) -> jax.Array:
            raise ValueError(why)

        return refuse

    renamed = copy.copy(model)
    for field, parameters in names.items():
        if (got := unfit_signature(getattr(model, field), parameters.count(",") + 1)) is not None:
            set_field(
                renamed, field, refusing(f"{field} takes ({parameters}), got a function of {got}")
            )
    return renamed


def sensor_functions(sensor: Sensor) -> tuple[Function, Function]:
    """The functions of a sensor: `observe` by (pose, landmark), `invert` by (pose, z, s)."""
    pose, landmark = robot_argument(sensor), Argument("landmark", sensor.landmark)
    free = tuple(f"s[{k}]" for k in range(len(sensor.free.mean)))
    inverse = (pose, Argument("measurement", sensor.measurements), Argument("free", free))
    return (
        Function(
            "observe",
            sensor.observe,
            (pose, landmark),
            sensor.measurements,
            sensor.observe_jacobians,
        ),
        Function("invert", sensor.invert, inverse, sensor.landmark, sensor.invert_jacobians),
    )


def robot_argument(sensor: Sensor) -> Argument:
    """The pose as a sensor gets it: with the further numbers of the robot that it asks for."""
    return Argument("pose", (*POSE, *sensor.robot))


def factor_function(factor: Factor) -> Function:
    """The residual of a factor of a graph by its variables and its measurement.

    A point has two coordinates.
    """
    entries = {"pose": POSE, "point": _POINT}
    counts = {kind: factor.variables.count(kind) for kind in entries}
    arguments = [
        Argument(kind if counts[kind] == 1 else f"{kind} {k + 1}", entries[kind])
        for k, kind in enumerate(factor.variables)
    ]
    hand = factor.jacobians

    def call(*values: jax.Array) -> jax.Array:
        return factor.residual(values[:-1], values[-1])

    def claim(*values: jax.Array) -> tuple[jax.Array | None, ...]:
        assert hand is not None
        return (*hand(values[:-1], values[-1]), None)

    return Function(
        "residual",
        call,
        (*arguments, Argument("measurement", factor.measurements)),
        factor.errors,
        None if hand is None else claim,
    )


def plain_function(
    call: Callable[..., jax.Array],
    jacobian: Claim | None,
    arguments: Mapping[str, Sequence[str] | int] | None = None,
    outputs: Sequence[str] | None = None,
    name: str | None = None,
    states: Sequence[ArrayLike] | None = None,
) -> Function:
    """A function of vectors, whose arguments have the names of its parameters.

    Lengths that neither `arguments` nor a parameter's name states are taken from the states.
    Raises ValueError where the length of an argument is not known.
    """
    name = name or str(getattr(call, "__name__", type(call).__name__))
    with refusals_of(name):
        if arguments is not None and not isinstance(arguments, Mapping):
            raise InvalidField("arguments", f"expected {{name: entries}}, got {arguments!r}")
        if isinstance(outputs, str):
            raise InvalidField("outputs", f"expected a tuple of names, got {outputs!r}")
        lengths = dict(arguments or {})
        parameters = _parameters(call, lengths)
        if unknown := [key for key in lengths if key not in parameters]:
            raise InvalidField(
                "arguments",
                f"expected those of {', '.join(parameters) or 'no parameter'}, got "
                f"{', '.join(unknown)}",
            )
        if not parameters:
            raise InvalidField(
                "", "expected a function with a parameter to differentiate by, got none"
            )
        named = {p: _entries(p, lengths.get(p, _GLOSSARY.get(p))) for p in parameters}
        shapes = [np.shape(table) for table in (() if states is None else states)]
        if len(shapes) == len(parameters) and all(len(shape) == 2 for shape in shapes):
            pairs = zip(parameters, shapes, strict=True)
            named |= {p: _number_names(p, shape[1]) for p, shape in pairs if named[p] is None}
        complete = {p: entries for p, entries in named.items() if entries is not None}
        if missing := [p for p in named if p not in complete]:
            line = ", ".join(
                f'"{parameter}": ("v [m/s]", "omega [rad/s]")' for parameter in missing
            )
            example = (
                f"arguments={{{line}}} in Python; in a file define a function, which has a name"
            )
            if name.isidentifier():
                example = f"{name}_arguments = {{{line}}} in the file, or arguments= in Python"
            raise InvalidField(
                "",
                f"the length of {', '.join(map(repr, missing))} is not known. Name the "
                f"entries, each with its unit: {example}",
            )
        arguments_of = tuple(Argument(p, entries) for p, entries in complete.items())
        return Function(name, call, arguments_of, tuple(outputs or ()), jacobian)


def _parameters(call: Callable[..., object], lengths: dict[str, Sequence[str] | int]) -> list[str]:
    """The names of a function's required parameters, or of `lengths` where Python has none."""
    try:
        signature = inspect.signature(call)
    except (TypeError, ValueError):
        if lengths:
            return list(lengths)
        raise
    return [
        p.name
        for p in signature.parameters.values()
        if p.default is p.empty and p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)
    ]


def _entries(parameter: str, entries: Sequence[str] | int | None) -> tuple[str, ...] | None:
    """The names of an argument's entries, or None where they are unknown."""
    if entries is None:
        return None
    with contextlib.suppress(TypeError):
        count = operator.index(entries)  # type: ignore[arg-type]  # also a whole number of NumPy
        if count < 0:
            raise InvalidField(parameter, f"expected a number of entries, got {count}")
        return _number_names(parameter, count)
    listed = isinstance(entries, Sequence) and not isinstance(entries, str)
    if not (isinstance(entries, Sequence) and listed and all(isinstance(e, str) for e in entries)):
        raise InvalidField(parameter, f"expected a tuple of names or their number, got {entries!r}")
    return tuple(entries)


def _number_names(parameter: str, count: int) -> tuple[str, ...]:
    return tuple(f"{parameter}[{k}]" for k in range(count))


def makes_a_model(factory: Callable[..., object]) -> bool:
    """Whether `build` makes a model of this: a class of motion models, sensors or factors whose
    fields have defaults, except noise_cov; a function annotated as a factory, `def mine(noise_cov,
    mount=…) -> Sensor`, or, without required parameters, `def mine() -> Factor`."""
    try:
        signature = inspect.signature(factory)
    except (TypeError, ValueError):
        return False
    required = [p.name for p in signature.parameters.values() if p.default is p.empty]
    if isinstance(factory, type):
        return issubclass(factory, Motion | Sensor | Factor) and required in ([], ["noise_cov"])
    returns = signature.return_annotation
    named = returns if isinstance(returns, str) else getattr(returns, "__name__", "")
    wanted = {"Motion": 1, "Sensor": 1, "Factor": 0}
    return wanted.get(named.rpartition(".")[2]) == len(required)
