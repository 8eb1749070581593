"""Parameters of a motion model as slowly varying states."""

import dataclasses
import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from jaxslam.core._record import field, record, static
from jaxslam.core._reprs import real_array
from jaxslam.core.logs._tables import label
from jaxslam.core.protocols import Motion
from jaxslam.core.validation import InvalidField, finite, instance_of, is_concrete, require
from jaxslam.math._arrays import Control, ProcessNoise, Robot


@record
class Augmented(Motion):
    """The motion model some of whose parameters are states: p ← p + w_p, a random walk.

    The k numbers of these fields of a model follow its state, and the values there are not used:
    start the robot with them. So what `jaxslam fit` holds constant, as the scales of `Corrected`,
    the filter estimates as it drifts.

        motion = Augmented(Corrected(Unicycle(Q)), "scale", noise=1e-3)

    Raises ValueError on a field that the model does not have, or that holds no numbers, or a noise
    below 0 or of another number of entries.
    """

    motion: Motion = field(check=instance_of(Motion))
    parameter: str | tuple[str, ...] = static()
    """the name of a field of the model, or of several, of k numbers together"""
    noise: ArrayLike = field()
    """() or (k,) standard deviation of the walk in a second, of a model with a control "dt [s]";
    of another one in a step"""
    unit: str = static(default="1", kw_only=True)
    """of the parameters, for the names of the states"""

    def __post_init__(self) -> None:
        names = [field.name for field in dataclasses.fields(self.motion)]
        for name in self.parameters:
            if name not in names:
                model = f"{type(self.motion).__name__}, {', '.join(names)}"
                raise InvalidField("parameter", f"expected a field of {model}, got {name!r}")
            values = getattr(self.motion, name)
            if dataclasses.is_dataclass(values) or real_array(values) is None:
                raise InvalidField("parameter", f"expected a field of numbers, got {name!r}")
        shapes = (), (len(self._names),)
        require("noise", self.noise, finite(*shapes[np.ndim(self.noise) > 0], least=0.0))
        super().__post_init__()

    @property
    def name(self) -> str:  # type: ignore[override]
        return f"{self.motion.name} with {' and '.join(self.parameters)}"

    @property
    def state(self) -> tuple[str, ...]:  # type: ignore[override]
        return (*self.motion.state, *self._names)

    @property
    def controls(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.motion.controls

    @property
    def noises(self) -> tuple[str, ...]:  # type: ignore[override]
        return (*self.motion.noises, *self._names)

    @property
    def equations(self) -> str:  # type: ignore[override]
        if not self.motion.equations or any(len(shape) > 1 for shape in self._shapes):
            return ""
        labels = list(map(label, self._names))
        # Before a name may become a list.
        lines = [f"{name}1 = {name} + w_{name}" for name in labels]
        rest = iter(labels)
        for name, shape in zip(self.parameters, self._shapes, strict=True):
            numbers = list(itertools.islice(rest, math.prod(shape)))
            lines += [f"{name} = [{', '.join(numbers)}]"] * len(shape)
        return "\n".join([*lines, self.motion.equations])

    def step(self, pose: Robot, u: Control, w: ProcessNoise) -> Robot:
        n, width = len(self.motion.state), len(self.motion.noises)
        moved = self._model(pose).step(pose[:n], u, w[:width])
        return jnp.concatenate([moved, pose[n:] + w[width:]])

    def noise_cov(self, pose: Robot, u: Control) -> Array:
        of_model = self._model(pose).noise_cov(pose[: len(self.motion.state)], u)
        variance = jnp.broadcast_to(jnp.asarray(self.noise, pose.dtype) ** 2, (len(self._names),))
        if "dt [s]" in self.controls:
            variance = variance * u[self.controls.index("dt [s]")]
        cov: Array = jax.scipy.linalg.block_diag(of_model, jnp.diag(variance))
        return cov

    @property
    def parameters(self) -> tuple[str, ...]:
        """The names of the fields that are states."""
        return (self.parameter,) if isinstance(self.parameter, str) else self.parameter

    @property
    def _shapes(self) -> list[tuple[int, ...]]:
        values = [getattr(self.motion, name) for name in self.parameters]
        # A tuple of numbers that are traced has a shape in JAX alone.
        return [np.shape(v) if is_concrete(v) else jnp.asarray(v).shape for v in values]

    @property
    def _names(self) -> tuple[str, ...]:
        """(k,) the names of the states."""
        names: list[str] = []
        for name, shape in zip(self.parameters, self._shapes, strict=True):
            count = math.prod(shape)
            numbers = [""] if count == 1 else [f" {k + 1}" for k in range(count)]
            names += [f"{name}{number} [{self.unit}]" for number in numbers]
        return tuple(names)

    def _model(self, robot: Robot) -> Motion:
        """The model with the parameters of a robot's state."""
        sizes = [math.prod(shape) for shape in self._shapes]
        ends = itertools.accumulate(sizes, initial=len(self.motion.state))
        values = {
            name: robot[first : first + size].reshape(shape)
            for name, shape, size, first in zip(
                self.parameters, self._shapes, sizes, ends, strict=False
            )
        }
        return dataclasses.replace(self.motion, **values)
