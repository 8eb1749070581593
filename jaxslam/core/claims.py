"""What a model claims of its functions, for `verify` to compare: derivatives, domains, units."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from jax import Array
from jax.typing import ArrayLike

__all__ = ["Argument", "Claim", "Gaussian", "Jacobian", "Points", "ValuesOf"]

Jacobian = Callable[..., ArrayLike | Sequence[ArrayLike | None]]
"""A hand-derived Jacobian: arguments -> one array (m, n_k) or None for each argument; or one array,
by the first argument or by all of them side by side."""


class Gaussian(NamedTuple):
    """The domain of an argument with a prior."""

    mean: ArrayLike
    cov: ArrayLike


class Points(NamedTuple):
    """The domain of a landmark: what stands for the points around the robot."""

    embed: Callable[[Array, Array], Array]
    """(pose (3,), point (2,)) -> the landmark at a point, first seen from the pose"""
    position: Callable[[Array], Array]
    """(landmark) -> its point (2,)"""
    frame: Callable[[Array], Array]
    """(pose) -> the pose of the sensor"""


class ValuesOf(NamedTuple):
    """The domain of an argument that another claim's function returns; its claim is the inverse."""

    claim: str
    """the name of that claim, which comes before"""
    support: Mapping[str, tuple[float, float]]
    """the open interval of an entry, by its name; others are not limited"""


@dataclass(frozen=True)
class Argument:
    """An argument of a function: the names of its entries, with units, and its domain."""

    name: str
    entries: tuple[str, ...]
    domain: Gaussian | Points | ValuesOf | None = None
    """None: random and difficult values by the units"""
    scale: float = 1.0
    """factor of its random values; where it is not 1, as of noise, half of them are 0"""
    cov: Callable[..., Array] | None = None
    """(arguments) -> its covariance, of noise"""
    exact: bool = False
    """whether it has no error, as a control"""


@dataclass(frozen=True)
class Claim:
    """A function of vectors, and what holds for it: its hand-derived Jacobian above all."""

    name: str
    function: Callable[..., Array]
    arguments: tuple[Argument, ...]
    outputs: tuple[str, ...]
    """names of its value's entries, with units; those in [rad] are compared modulo 2π"""
    jacobian: Jacobian | None = None
    """None: the derivatives are computed in several ways and compared with each other"""
    equal: Mapping[str, Callable[..., Array]] = field(default_factory=dict)
    """other functions of the arguments with the same values, by the equation that says so"""
    wrapped: bool = False
    """whether it returns angles in (-π, π]"""
    everywhere: bool = False
    """whether it is finite also where places coincide; if not, that is a note"""
    residual: Callable[[Array, Array], Array] | None = None
    """(value, value) -> their difference, angles wrapped"""
    noise_cov: Callable[..., Array] | None = None
    """(arguments) -> the covariance of noise added to its value"""
    states: Callable[[int, int], tuple[tuple[Any, ...], tuple[str, ...]]] | None = None
    """(number of random states, seed) -> arrays (S, n_k), and S labels; None: by the domains"""
