"""Two landmarks that are one, one of them begun after the other was last seen: found and merged."""

import jax
import jax.numpy as jnp

from jaxslam.filters.ekf.coordinates import cov_of_coordinates
from jaxslam.filters.map_management.merging import closest_pair, merge
from jaxslam.math.xla import where_any
from jaxslam.protocols import Chart
from jaxslam.slots import Joint

Array = jax.Array


def merged(joint: Joint, chart: Chart, old: Array, new: Array) -> Joint:
    """The landmark of slot new made that of slot old, with both histories; nothing if the same."""
    after = merge(joint, chart, old, new)
    known = joint.life
    gone = joint.alive & ~after.alive
    one = gone.any()

    def grown(times: Array, value: Array) -> Array:
        return jnp.where(gone, 0, times.at[old].set(jnp.where(one, value, times[old])))

    life = known._replace(
        born=grown(known.born, jnp.minimum(known.born[old], known.born[new])),
        last=grown(known.last, jnp.maximum(known.last[old], known.last[new])),
        seen=grown(known.seen, known.seen[old] + known.seen[new]),
    )
    return after._replace(life=life)


def double(joint: Joint, chart: Chart, reach: float, spread: float) -> tuple[Array, Array, Array]:
    """The older and the younger of the two landmarks most likely one, and their d²."""
    known, capacity = joint.life, joint.alive.shape[0]
    later = known.born[:, None] > known.last[None, :]
    near = ((joint.landmarks[:, None] - joint.landmarks[None, :]) ** 2).sum(axis=2) <= reach**2
    pairs = (later | later.T) & joint.alive[:, None] & joint.alive[None, :] & near

    def search(joint: Joint) -> tuple[Array, Array, Array]:
        cov = cov_of_coordinates(joint, chart)[3:, 3:].reshape(capacity, 2, capacity, 2)
        every = jnp.arange(capacity)
        own = jnp.trace(cov[every, :, every], axis1=1, axis2=2)
        mixed = cov[:, 0, :, 0] + cov[:, 1, :, 1]
        variance = own[:, None] + own[None, :] - 2 * mixed
        i, j, d = closest_pair(joint, chart, reach, pairs & (variance <= 2 * spread**2))
        first = known.born[i] <= known.born[j]
        i, j = jnp.where(first, i, j), jnp.where(first, j, i)
        return i.astype(jnp.int32), j.astype(jnp.int32), d

    def nothing(joint: Joint) -> tuple[Array, Array, Array]:
        zero = jnp.zeros((), jnp.int32)
        return zero, zero, jnp.full((), jnp.inf, joint.cov.dtype)

    return where_any(pairs.any(), search, nothing, joint)
