"""The models of a table: with the noise as a parameter, and which of them its columns fit."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Generic, NamedTuple, NoReturn, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from jaxslam.logs.tables import odometry_columns, split_unit
from jaxslam.protocols import Motion, Sensor
from jaxslam.types import JaxOrNumPy

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
