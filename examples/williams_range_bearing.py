"""Williams' observation Jacobian H_x as printed, whose mistake `jaxslam verify` finds.

Row 1 has the signs of ∂r/∂landmark, not of ∂r/∂robot (Δ points from the robot to the landmark).
"""

import jax.numpy as jnp

observe_outputs = ("range [m]", "bearing [rad]")


def observe(pose, landmark):
    """z = (|Δ|, atan2(Δy, Δx) - θ)."""
    dx, dy = landmark - pose[:2]
    return jnp.stack([jnp.hypot(dx, dy), jnp.arctan2(dy, dx) - pose[2]])


def observe_jacobian(pose, landmark):
    """The Jacobian by the pose; there is no claim by the landmark."""
    dx, dy = landmark - pose[:2]
    r2 = dx**2 + dy**2
    r = jnp.sqrt(r2)
    return jnp.array([[dx / r, dy / r, 0.0], [dy / r2, -dx / r2, -1.0]])
