"""The rows of a measurement in a linearized chain, and the difference of two poses."""

from jaxtyping import Array, Float

from jaxslam.linearize import first_order
from jaxslam.math import linalg
from jaxslam.math.angles import wrap
from jaxslam.protocols import Sensor

Rows = tuple[Array, Array, Array, Array]
"""A (Z, 3), B (Z, L) and b (Z,) of a measurement, as in `LinearizedStep`, in units of its
noise; and () bool, whether the covariance of that noise is positive definite."""


def whitened_rows(
    sensor: Sensor, z: Float[Array, "Z"], pose: Float[Array, "3"], landmark: Float[Array, "L"]
) -> Rows:
    """The rows of a measurement: R^{-1/2} times H_pose, H_l and z ⊖ h."""
    by_pose, by_landmark = first_order.observe_jacobians(sensor, pose, landmark)
    innovation = sensor.residual(z, sensor.observe(pose, landmark))
    factor, positive = linalg.cholesky(sensor.noise_cov(z))
    a, b, r = (linalg.solve_lower(factor, part) for part in (by_pose, by_landmark, innovation))
    return a, b, r, positive


def pose_difference(a: Float[Array, "3"], b: Float[Array, "3"]) -> Float[Array, "3"]:
    """The difference a - b of two poses by coordinates, with the angle wrapped."""
    off = a - b
    return off.at[2].set(wrap(off[2]))
