"""Arrays that have names of their own, for signatures; shapes are checked while the tests run."""

from jax import Array
from jaxtyping import Float

Scalar = Float[Array, ""]
Pose = Float[Array, "3"]
"""(x, y, θ) [m, m, rad]; θ in (-π, π] where a pose is returned"""
Point = Float[Array, "2"]
"""(x, y) [m], or (range, bearing) [m, rad] where polar"""
PoseMatrix = Float[Array, "3 3"]
"""by the coordinates of a pose: a covariance, or a Jacobian"""
PointMatrix = Float[Array, "2 2"]
PointByPose = Float[Array, "2 3"]
