"""Named array types for signatures; their shapes are checked in the tests.

Of one pose, one landmark, one measurement; `vmap` and `scan` add leading axes.
"""

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

Control = Float[Array, "U"]
ProcessNoise = Float[Array, "W"]
ProcessNoiseCov = Float[Array, "W W"]
StepJacobians = tuple[PoseMatrix, Float[Array, "3 U"], Float[Array, "3 W"]]
"""∂pose'/∂(pose, u, w)"""

Landmark = Float[Array, "L"]
Measurement = Float[Array, "Z"]
Unmeasured = Float[Array, "K"]
"""landmark parameters that the measurement does not determine"""
ObserveJacobians = tuple[Float[Array, "Z 3"], Float[Array, "Z L"]]
"""∂z/∂(pose, l)"""
InvertJacobians = tuple[Float[Array, "L 3"], Float[Array, "L Z"], Float[Array, "L K"]]
"""∂l/∂(pose, z, s)"""
