"""The velocity motion of the Notes and its printed Jacobian, whose mistakes `jaxslam verify` finds.

Row 2 has a wrong sign, and the matrix after "I +" has a 1 at (3, 3) instead of a 0. The motion
itself divides by ω, so it is undefined at ω = 0; `jaxslam.motion.Velocity` is not.
"""

import jax.numpy as jnp

move_arguments = {"u": ("v [m/s]", "omega [rad/s]", "dt [s]")}
move_outputs = ("x [m]", "y [m]", "theta [rad]")


def move(pose, u):
    """The pose after an arc of radius v/ω."""
    (x, y, theta), (v, omega, dt) = pose, u
    turned = theta + omega * dt
    return jnp.stack(
        [
            x - v / omega * jnp.sin(theta) + v / omega * jnp.sin(turned),
            y + v / omega * jnp.cos(theta) - v / omega * jnp.cos(turned),
            turned,
        ]
    )


def move_jacobian(pose, u):
    """G_x of the Notes, by the pose."""
    theta, (v, omega, dt) = pose[2], u
    turned = theta + omega * dt
    column = jnp.stack(
        [
            -v / omega * jnp.cos(theta) + v / omega * jnp.cos(turned),
            v / omega * jnp.sin(theta) + v / omega * jnp.sin(turned),
            1.0,
        ]
    )
    return jnp.eye(3).at[:, 2].add(column)
