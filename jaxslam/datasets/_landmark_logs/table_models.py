"""Models of a table: by its columns, and with the noise of a line of odometry."""

from collections.abc import Callable, Mapping, Sequence
from typing import Generic, NamedTuple, NoReturn, TypeVar

import jax
import jax.numpy as jnp

from jaxslam.core._record import record, static
from jaxslam.core.logs._tables import INTERVAL, odometry_columns, split_unit
from jaxslam.core.protocols import Motion, Sensor
from jaxslam.core.types import JaxOrNumPy
from jaxslam.datasets._dataset import Parameter

_Model = TypeVar("_Model", bound=Motion | Sensor)

_DEFAULT_MODELS = ("unicycle", "pose_increment", "range_bearing")
"""The default among models with the same columns."""


class Parametric(NamedTuple, Generic[_Model]):
    """A model as a function of its parameters, and the model of the file."""

    parameters: tuple[Parameter, ...]
    at: Callable[[JaxOrNumPy], _Model]
    """array of values -> model"""
    model: _Model
    """the model with the values of the file, without systematic errors that the file does not
    state"""


def fitting_model(
    registry: Mapping[str, Callable[..., Motion | Sensor]],
    header: Sequence[str],
) -> str:
    """The model whose columns are in the header, by most columns and then by `_DEFAULT_MODELS`.

    Raises ValueError, with the columns of all models, if there is none.
    """
    columns_of_file = {split_unit(name)[0] for name in header}
    # A motion without odometry, whose columns are none, fits any file.
    registry = {name: factory for name, factory in registry.items() if name != "constant_velocity"}
    fitting, described = [], []
    for name, factory in registry.items():
        model = factory(of_no_noise)
        columns = (
            odometry_columns(model.controls, header)
            if isinstance(model, Motion)
            else model.measurements
        )
        described.append(f"{name} ({', '.join(columns)})")
        if {split_unit(column)[0] for column in columns} <= columns_of_file:
            fitting.append((len(columns), name in _DEFAULT_MODELS, name))
    if not fitting:
        raise ValueError(
            f"expected one, since no model has the columns {', '.join(header)}; known: "
            + "; ".join(described)
        )
    # Without the name in the key: of equal models the first in the registry.
    return max(fitting, key=lambda fit: fit[:2])[2]


def of_no_noise(*_: object) -> NoReturn:
    """The noise of a model that serves only for its names, and is never evaluated."""
    raise AssertionError("a model that serves only for its names was evaluated")


@record
class TableNoise:
    """The noise of a line of odometry, whatever rows divide it; see `TableSettings.motion`."""

    deviations: JaxOrNumPy
    """standard deviations over one interval"""
    interval: float
    """time between lines of odometry [s]"""
    per_time: bool = static()
    """whether the last control is Δt"""
    of_increments: bool = static()
    """whether the covariance grows with Δt, as of increments; else it shrinks, as of velocities"""
    walks: JaxOrNumPy | None = None
    """standard deviations, in a second, of the further states whose rates are the last noises"""

    def __call__(self, pose: jax.Array, u: jax.Array) -> jax.Array:
        cov = jnp.diag(jnp.asarray(self.deviations, u.dtype) ** 2)
        if self.of_increments:
            return cov * u[-1] / self.interval
        if self.per_time:
            moving = u[-1] > 0
            # The inner `where` keeps gradients finite at Δt = 0.
            per_time = jnp.where(moving, 1 / jnp.where(moving, u[-1], 1.0), 0.0)
            cov = cov * (self.interval * per_time)
            if self.walks is not None:
                walks = jnp.diag(jnp.asarray(self.walks, u.dtype) ** 2) * per_time
                cov = jax.scipy.linalg.block_diag(cov, walks)
        return cov


@record
class WithInterval(Motion):
    """A motion model with Δt as a last control, which only its noise depends on."""

    motion: Motion
    noise_cov: TableNoise

    @property
    def name(self) -> str:  # type: ignore[override]
        return self.motion.name

    @property
    def controls(self) -> tuple[str, ...]:  # type: ignore[override]
        return (*self.motion.controls, INTERVAL)

    @property
    def noises(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.motion.noises

    @property
    def perturb(self) -> Callable[[jax.Array, jax.Array], jax.Array] | None:
        return None if self.motion.perturb is None else self._perturb

    def step(self, pose: jax.Array, u: jax.Array, w: jax.Array) -> jax.Array:
        return self.motion.step(pose, u[:-1], w)

    def _perturb(self, u: jax.Array, w: jax.Array) -> jax.Array:
        return jnp.concatenate([self.motion.perturb(u[:-1], w), u[-1:]])
