"""Functions to verify, with names and units of their arguments and outputs."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import jax
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxslam.protocols import Motion, Sensor

Claim: TypeAlias = Callable[..., ArrayLike | Sequence[ArrayLike | None]]
"""A hand-derived Jacobian: arguments -> one array, or one array or None for each argument."""

POSE = ("x [m]", "y [m]", "theta [rad]")
POINT = ("x [m]", "y [m]")
GLOSSARY = {
    "pose": POSE,
    "frame": POSE,
    "landmark": POINT,
    "l": POINT,
    "point": POINT,
}
"""Default entries of an argument by its name."""

_PERIODS = {"[rad]": 2 * np.pi, "[deg]": 360.0, "[°]": 360.0}


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

    @property
    def periods(self) -> Float[np.ndarray, "m"]:
        """The periods of the outputs, inf of those on a line."""
        return periods(self.outputs)


def periods(names: Sequence[str]) -> Float[np.ndarray, "m"]:
    """The periods of quantities by their units: 2π of [rad], 360 of [deg], inf of all else."""
    return np.array([_PERIODS.get(name.split(" ")[-1], np.inf) for name in names])


def motion_functions(motion: Motion) -> tuple[Function]:
    """The function of a motion model: `step` by pose, control and noise."""
    arguments = (
        Argument("pose", POSE),
        Argument("control", motion.controls),
        Argument("noise", motion.noises, scale=0.1),
    )
    return (Function("step", motion.step, arguments, POSE, motion.jacobians),)


def sensor_functions(sensor: Sensor) -> tuple[Function, Function]:
    """The functions of a sensor: `observe` by (pose, landmark), `invert` by (pose, z, s)."""
    pose, landmark = Argument("pose", POSE), Argument("landmark", sensor.landmark)
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


def plain_function(
    call: Callable[..., jax.Array],
    jacobian: Claim | None,
    arguments: Mapping[str, Sequence[str] | int] | None = None,
    outputs: Sequence[str] | None = None,
    name: str | None = None,
) -> Function:
    """A function of vectors, whose arguments are known by the names of its parameters.

    Raises ValueError where the size of an argument is neither given nor follows from its name.
    """
    name = name or str(getattr(call, "__name__", type(call).__name__))
    if arguments is not None and not isinstance(arguments, Mapping):
        raise ValueError(f"{name}: expected its arguments as {{name: entries}}, got {arguments!r}")
    if isinstance(outputs, str):
        raise ValueError(f"{name}: expected its outputs as a tuple of names, got {outputs!r}")
    given = dict(arguments or {})
    if given and not _has_signature(call):
        parameters = list(given)
    else:
        parameters = [
            p.name
            for p in inspect.signature(call).parameters.values()
            if p.default is p.empty and p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)
        ]
    if unknown := [key for key in given if key not in parameters]:
        raise ValueError(
            f"{name}: no parameter {', '.join(unknown)}; it has {', '.join(parameters) or 'none'}"
        )
    if not parameters:
        raise ValueError(f"{name}: takes no argument to differentiate by")
    named = []
    for parameter in parameters:
        entries = given.get(parameter, GLOSSARY.get(parameter))
        if entries is None:
            raise ValueError(
                f"{name}: how long is its argument {parameter!r}? Say so with arguments="
                f'{{"{parameter}": ("v [m/s]", …)}}, or in a file with {name}_arguments = …'
            )
        if isinstance(entries, int):
            entries = tuple(f"{parameter}[{k}]" for k in range(entries))
        if isinstance(entries, str) or not all(isinstance(entry, str) for entry in entries):
            raise ValueError(f"{name}: {parameter}: expected a tuple of names, got {entries!r}")
        named.append(Argument(parameter, tuple(entries)))
    return Function(name, call, tuple(named), tuple(outputs or ()), jacobian)


def _has_signature(call: Callable[..., object]) -> bool:
    """Whether Python knows the parameters of a callable."""
    try:
        inspect.signature(call)
    except (TypeError, ValueError):
        return False
    return True
