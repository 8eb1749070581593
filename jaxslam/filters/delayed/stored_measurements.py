"""The first step of delayed initialization: new measurements become variables of the state."""

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Int

from jaxslam import slots
from jaxslam.filters.delayed.settings import DelayedSettings
from jaxslam.filters.delayed.state import (
    DelayedState,
    NewMeasurements,
    delete_slots_if_any,
    increased,
    is_newer,
    slots_where,
)


def store_measurements(
    settings: DelayedSettings, state: DelayedState, new: NewMeasurements
) -> tuple[DelayedState, Int[Array, "M"], Bool[Array, "M"]]:
    """The state with new measurements stored; their slots, and which were stored.

    One is stored if the sensor is far enough from its positions at other measurements of the same
    tag. Where the table is full the oldest are marginalized out.
    """
    layout, joint = settings.layout, state.joint
    store = partial(settings.triangulation.store, settings.sensor)
    values = jax.vmap(store, (None, 0))(joint.pose, new.z)
    by_pose, by_z = jax.vmap(jax.jacfwd(store, argnums=(0, 1)), (None, 0))(joint.pose, new.z)
    alive, tag = joint.alive[layout.of_stored], joint.tag[layout.of_stored]
    offset = values[:, None, :2] - joint.landmarks[None, layout.of_stored, :2]
    close = ((offset**2).sum(axis=2) < settings.stored.spacing**2) & alive[None]
    wanted = new.wanted & ~(close & (new.tag[:, None] == tag[None])).any(axis=1)

    needed = wanted.sum() - (~alive).sum()
    age = jnp.where(alive, state.taken_at, state.clock + 1)
    evicted = alive & (is_newer(age).sum(axis=0) < needed)
    state = delete_slots_if_any(layout, state, slots_where(layout, stored=evicted))

    joint = state.joint
    place, stored = slots.allocate(joint.alive[layout.of_stored], wanted)
    noise_cov = jax.vmap(settings.sensor.noise_cov)(new.z)
    own_cov = jnp.einsum("mij,mjk,mlk->mil", by_z, noise_cov, by_z)
    slot = layout.first_stored + place
    joint = slots.scatter(joint, slot, stored, values, by_pose, own_cov, new.tag)
    at = jnp.where(stored, place, layout.stored)  # beyond the end: dropped
    state = state._replace(
        joint=joint,
        taken_at=state.taken_at.at[at].set(state.clock, mode="drop"),
        noise_var=state.noise_var.at[at].set(own_cov[:, 2, 2], mode="drop"),
        counts=state.counts._replace(evicted=increased(state.counts.evicted, evicted)),
    )
    return state, slot, stored
