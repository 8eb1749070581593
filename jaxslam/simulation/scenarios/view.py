"""Fields of view: which landmarks a simulated sensor reports."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.numbers import is_concrete
from jaxslam.core.record import record
from jaxslam.math.arrays import Landmark, Number, Pose


@record
class BetweenRanges:
    """A field of view all around, from nearest to farthest metres (both excluded).

    Raises ValueError unless 0 <= nearest < farthest.
    """

    nearest: Number
    farthest: Number

    def __post_init__(self) -> None:
        if is_concrete(self.nearest, self.farthest) and not np.all(
            (np.asarray(self.nearest) >= 0) & (self.nearest < np.asarray(self.farthest))
        ):
            raise ValueError(
                f"BetweenRanges: expected 0 <= nearest < farthest, got {self.nearest} and "
                f"{self.farthest}"
            )

    def __call__(self, pose: Pose, landmark: Landmark) -> jax.Array:
        squared = jnp.sum((landmark[:2] - pose[:2]) ** 2)
        nearest, farthest = (jnp.asarray(x, pose.dtype) for x in (self.nearest, self.farthest))
        return (squared > nearest**2) & (squared < farthest**2)
