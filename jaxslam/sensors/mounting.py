"""The pose of a sensor on the robot: Solà's S, constant in the robot's frame."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from jaxslam.math import se2
from jaxslam.math.arrays import Pose
from jaxslam.validation.numbers import check_mount, is_concrete

NO_OFFSET = (0.0, 0.0, 0.0)


def mounting(
    name: str, mount: ArrayLike
) -> tuple[Callable[[Array], Array], Callable[[Array], Array]]:
    """The functions pose -> pose ∘ mount and its derivative by the pose (3, 3).

    Raises ValueError unless mount is a finite (3,); a traced mount is checked for its shape alone.
    """
    check_mount(name, mount)
    at_origin = is_concrete(mount) and not np.any(np.asarray(mount))

    def sensor_pose(pose: Pose) -> Array:
        if at_origin:
            return pose
        return se2.compose(pose, jnp.asarray(mount, pose.dtype))

    def jacobian(pose: Pose) -> Array:
        return se2.compose_jacobians(pose, jnp.asarray(mount, pose.dtype))[0]

    return sensor_pose, jacobian
