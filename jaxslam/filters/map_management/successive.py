"""Successive duplicates: one landmark was initialized after the other was last measured."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxslam.filters.ekf.coordinates.map_coordinates import cov_of_coordinates
from jaxslam.filters.map_management.merging import closest_pair, merge_landmarks
from jaxslam.life import Times
from jaxslam.math.arrays import Number
from jaxslam.math.xla import where_any
from jaxslam.protocols import Chart
from jaxslam.slots import Joint


def merge_histories(joint: Joint, chart: Chart, old: Int[Array, ""], new: Int[Array, ""]) -> Joint:
    """The map with slot new merged into slot old, including their times; unchanged if equal."""
    after = merge_landmarks(joint, chart, old, new)
    known: Times = joint.life
    freed = joint.alive & ~after.alive
    happened = freed.any()

    def of_both(times: Array, value: Array) -> Array:
        return jnp.where(freed, 0, times.at[old].set(jnp.where(happened, value, times[old])))

    life = known._replace(
        born=of_both(known.born, jnp.minimum(known.born[old], known.born[new])),
        last=of_both(known.last, jnp.maximum(known.last[old], known.last[new])),
        seen=of_both(known.seen, known.seen[old] + known.seen[new]),
    )
    return after._replace(life=life)


def successive_duplicate(
    joint: Joint, chart: Chart, reach: Number, spread: Number
) -> tuple[Int[Array, ""], Int[Array, ""], Float[Array, ""]]:
    """The older and the younger slot of the likeliest duplicates, and their squared distance.

    Of pairs within reach [m] of which one was initialized after the other was last measured, and
    whose difference is known to √(tr cov(δ)/2) <= spread [m]; infinite where there is none.
    """
    known: Times = joint.life
    capacity = joint.alive.shape[0]
    later = known.born[:, None] > known.last[None, :]
    near = ((joint.landmarks[:, None] - joint.landmarks[None, :]) ** 2).sum(axis=2) <= reach**2
    pairs = (later | later.T) & joint.alive[:, None] & joint.alive[None, :] & near

    def search(joint: Joint) -> tuple[Array, Array, Array]:
        cov = cov_of_coordinates(joint, chart)[3:, 3:].reshape(capacity, 2, capacity, 2)
        every = jnp.arange(capacity)
        own = jnp.trace(cov[every, :, every], axis1=1, axis2=2)
        mixed = cov[:, 0, :, 0] + cov[:, 1, :, 1]
        variance = own[:, None] + own[None, :] - 2 * mixed
        i, j, distance = closest_pair(joint, chart, reach, pairs & (variance <= 2 * spread**2))
        first = known.born[i] <= known.born[j]
        i, j = jnp.where(first, i, j), jnp.where(first, j, i)
        return i.astype(jnp.int32), j.astype(jnp.int32), distance

    def nothing(joint: Joint) -> tuple[Array, Array, Array]:
        zero = jnp.zeros((), jnp.int32)
        return zero, zero, jnp.full((), jnp.inf, joint.cov.dtype)

    return where_any(pairs.any(), search, nothing, joint)
