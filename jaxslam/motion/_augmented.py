"""Parameters of a motion model as slowly varying states."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from jaxslam.core._record import field, record, static
from jaxslam.core._reprs import real_array
from jaxslam.core.protocols import Motion
from jaxslam.core.validation import InvalidField, finite, instance_of, require
from jaxslam.math._arrays import Control, ProcessNoise, Robot


@record
class Augmented(Motion):
    """The motion model whose parameter is a state: p ← p + w_p, a random walk.

    The k numbers of the field `parameter` of a model follow its state, and its own value there is
    not used: start the robot with it. So what `jaxslam fit` holds constant, as the scales of
    `Corrected`, the filter estimates as it drifts.

        motion = Augmented(Corrected(Unicycle(Q)), "scale", noise=1e-3)

    Raises ValueError on a field that the model does not have, or that holds no numbers, or a noise
    below 0 or of another number of entries.
    """

    motion: Motion = field(check=instance_of(Motion))
    parameter: str = static()
    """the name of a field of the model, of k numbers"""
    noise: ArrayLike = field()
    """() or (k,) standard deviation of the walk in a second, of a model with a control "dt [s]";
    of another one in a step"""
    unit: str = static(default="1", kw_only=True)
    """of the parameter, for the names of the states"""

    def __post_init__(self) -> None:
        names = [field.name for field in dataclasses.fields(self.motion)]
        if self.parameter not in names:
            model = f"{type(self.motion).__name__}, {', '.join(names)}"
            reason = f"expected a field of {model}, got {self.parameter!r}"
            raise InvalidField("parameter", reason)
        values = getattr(self.motion, self.parameter)
        if dataclasses.is_dataclass(values) or real_array(values) is None:
            reason = f"expected a field of numbers, got {self.parameter!r}"
            raise InvalidField("parameter", reason)
        shapes = (), (self._size,)
        require("noise", self.noise, finite(*shapes[np.ndim(self.noise) > 0], least=0.0))
        super().__post_init__()

    @property
    def name(self) -> str:  # type: ignore[override]
        return f"{self.motion.name} with {self.parameter}"

    @property
    def state(self) -> tuple[str, ...]:  # type: ignore[override]
        return (*self.motion.state, *self._names)

    @property
    def controls(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.motion.controls

    @property
    def noises(self) -> tuple[str, ...]:  # type: ignore[override]
        return (*self.motion.noises, *self._names)

    def step(self, pose: Robot, u: Control, w: ProcessNoise) -> Robot:
        n, width = len(self.motion.state), len(self.motion.noises)
        moved = self._model(pose).step(pose[:n], u, w[:width])
        return jnp.concatenate([moved, pose[n:] + w[width:]])

    def noise_cov(self, pose: Robot, u: Control) -> Array:
        of_model = self._model(pose).noise_cov(pose[: len(self.motion.state)], u)
        variance = jnp.broadcast_to(jnp.asarray(self.noise, pose.dtype) ** 2, (self._size,))
        if "dt [s]" in self.controls:
            variance = variance * u[self.controls.index("dt [s]")]
        cov: Array = jax.scipy.linalg.block_diag(of_model, jnp.diag(variance))
        return cov

    @property
    def _size(self) -> int:
        """k."""
        return math.prod(np.shape(getattr(self.motion, self.parameter)))

    @property
    def _names(self) -> tuple[str, ...]:
        if self._size == 1:
            return (f"{self.parameter} [{self.unit}]",)
        return tuple(f"{self.parameter} {k + 1} [{self.unit}]" for k in range(self._size))

    def _model(self, robot: Robot) -> Motion:
        """The model with the parameter of a robot's state."""
        shape = np.shape(getattr(self.motion, self.parameter))
        values = robot[len(self.motion.state) :].reshape(shape)
        return dataclasses.replace(self.motion, **{self.parameter: values})
