"""The models of a table, and its association method by name.

The models have their noise as a parameter; those are taken that the columns fit. The gate of an
association is given by its probability.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Generic, NamedTuple, NoReturn, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from jaxslam.association import (
    GlobalNearest,
    JointCompatibility,
    Known,
    MaximumLikelihood,
    Nearest,
)
from jaxslam.core.logs.tables import odometry_columns, split_unit
from jaxslam.core.protocols import Associate, Motion, Sensor
from jaxslam.core.types import JaxOrNumPy
from jaxslam.filters.ekf.settings import EkfOptions
from jaxslam.math import stats

_Model = TypeVar("_Model", bound=Motion | Sensor)

_FIRST = ("unicycle", "pose_increment", "range_bearing")
"""Of models with the same columns, those taken by default."""


class Parametric(NamedTuple, Generic[_Model]):
    """A model by the standard deviations of its noise and its mount, and what the file says."""

    names: tuple[str, ...]
    deviations: tuple[float, ...]
    mount: tuple[float, ...] | None
    """None where the model has none"""
    make: Callable[[JaxOrNumPy, ArrayLike | None], _Model]
    """(deviations (W,) an array, mount (3,) or None) -> model"""

    def made(self) -> _Model:
        """The model that the file describes."""
        return self.make(np.array(self.deviations), self.mount)


def fitting_model(
    section: str,
    registry: Mapping[str, Callable[..., Motion | Sensor]],
    given: Sequence[str],
    path: Path,
) -> str:
    """The model whose columns are given; of several the one with most, then of `_FIRST`."""
    bare = {split_unit(name)[0] for name in given}
    fitting, known = [], []
    for name, factory in registry.items():
        model = factory(of_no_noise)
        names = (
            odometry_columns(model.controls, given)
            if isinstance(model, Motion)
            else model.measurements
        )
        known.append(f"{name} ({', '.join(names)})")
        if {split_unit(one)[0] for one in names} <= bare:
            fitting.append((len(names), name in _FIRST, name))
    if not fitting:
        raise ValueError(
            f"{path}: [{section}] model: expected one, since no model has the columns "
            f"{', '.join(given)}; there are {'; '.join(known)}"
        )
    most = max(fitting)[:2]
    return next(name for *rank, name in fitting if tuple(rank) == most)


def of_no_noise(*_: object) -> NoReturn:
    """The noise of a model that is made for its names alone, and is never evaluated."""
    raise AssertionError("a model that was made for its names was evaluated")


GATE = 0.99
"""Default probability of the gate of an association."""

NEW_GATE = 0.9999
"""Probability beyond which a measurement is of a new landmark."""

METHODS: dict[str, Callable[..., Associate]] = {
    "nearest": Nearest,
    "global_nearest": GlobalNearest,
    "maximum_likelihood": MaximumLikelihood,
    "joint": JointCompatibility,
    "known": Known,
}


def association_options(method: object, gate: object, size: int) -> EkfOptions:
    """Options of `EkfSlam` for a method by name and a gate by probability.

    Raises ValueError, "associate: …" or "gate: …", on a name that is none and a gate that is no
    probability. Known identities need no gate (None); other methods take `GATE`.

    Args:
        method: one of `METHODS`.
        gate: the probability that a correct measurement passes.
        size: numbers of a measurement.
    """
    probability = None if gate is None else _probability(gate)
    if not isinstance(method, str) or method not in METHODS:
        raise ValueError(f"associate: expected one of {', '.join(METHODS)}, got {method!r}")
    if method == "known":
        return {} if probability is None else {"gate": stats.chi2_quantile(probability, size)}
    inner = GATE if probability is None else probability
    beyond = stats.chi2_quantile(max(inner, NEW_GATE), size)
    limit = inner if method == "joint" else stats.chi2_quantile(inner, size)
    return {"associate": METHODS[method](limit, beyond)}


def _probability(gate: object) -> float:
    """The probability that a gate is given by; ValueError where it is none."""
    if not isinstance(gate, int | float) or isinstance(gate, bool) or not 0 < gate < 1:
        raise ValueError(f"gate: expected a probability between 0 and 1, got {gate!r}")
    return gate


def is_number(value: object) -> bool:
    """Whether a value of a file is a finite number."""
    return (
        isinstance(value, int | float) and not isinstance(value, bool) and bool(np.isfinite(value))
    )
