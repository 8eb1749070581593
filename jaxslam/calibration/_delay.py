"""The delay of measurements after odometry, as a number that a log can be differentiated by."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxslam.core.logs._tables import INTERVAL, split_unit
from jaxslam.core.types import Log


def delayed(
    log: Log, time: Float[np.ndarray, "T"], controls: tuple[str, ...], delay: jax.Array | float
) -> Log:
    """The log with the controls that lead to when its measurements happened.

    A measurement recorded at t happened at t - delay, so that the control of a row moves the robot
    from t_{k-1} - delay to t_k - delay. Its velocities are means over that interval and increments
    sums, which is exact where they are constant. Before the first row the robot stands still.

    Args:
        log: T rows, recorded, as with a delay of 0.
        time: (T,) of the rows, rising [s].
        controls: names with units; those in /s are velocities over the control `dt [s]`.
        delay: [s], may be traced.
    Raises:
        ValueError: on controls that are neither velocities over an interval nor increments of one.
    """
    if controls[-1:] != (INTERVAL,):
        raise ValueError(
            f"a delay needs odometry with an interval, {INTERVAL}, got {', '.join(controls)}"
        )
    u = jnp.asarray(log.control)
    t = jnp.asarray(time - time[0], u.dtype)
    dt = u[:, -1:]
    rates = np.array([(split_unit(name)[1] or "").endswith("/s") for name in controls[:-1]])
    moved = jnp.where(rates, u[:, :-1] * dt, u[:, :-1])
    total = jnp.cumsum(moved, axis=0)
    # Linear between rows: exact for velocities that are constant over a row.
    at = jax.vmap(lambda column: jnp.interp(t - delay, t, column), 1, 1)(total)
    moved = jnp.diff(at, axis=0, prepend=at[:1])
    has_interval = dt > 0
    velocities = jnp.where(has_interval, moved / jnp.where(has_interval, dt, 1.0), 0.0)
    return log._replace(control=jnp.concatenate([jnp.where(rates, velocities, moved), dt], axis=1))
