"""Mean recovery in a `sparse_state.Sparse`: coordinate descent on ½ eᵀ Ω e - ρᵀ e, block by block.

A block that solves for its own error δ moves its mean by it, owes nothing any more, and passes on
what its neighbours owe then: ρ_j ← ρ_j - Ω_ji δ_i. Ω and ξ = Ω μ + ρ are left as they are.
"""

import jax
import jax.numpy as jnp

from jaxslam.filters.information import canonical
from jaxslam.filters.information.sparse_state import Sparse
from jaxslam.math import linalg
from jaxslam.math.xla import settle


def owed_of(state: Sparse) -> jax.Array:
    """ρ of the area, (3 + 2A,)."""
    own = state.owed.at[state.slot].get(mode="fill", fill_value=0)
    return jnp.concatenate([state.owed_robot, own.reshape(-1)])


def owing(state: Sparse, owed: jax.Array) -> Sparse:
    """The state with ρ (3 + 2A,) of the area."""
    own = owed[3:].reshape(-1, 2)
    after = state.owed.at[state.slot].set(own, mode="drop")
    return state._replace(owed_robot=owed[:3], owed=after)


def passed_on(state: Sparse, slot: jax.Array, step: jax.Array) -> Sparse:
    """Landmarks slot (m,) moved by step (m, 2), and what the landmarks of their lists owe then."""
    n = state.own.shape[0]
    row = state.neighbours.at[slot].get(mode="fill", fill_value=n)
    links = state.links.at[slot].get(mode="fill", fill_value=0)
    # Who writes to the lists next needs the slots, so waits for this, and needs no copy of all N.
    row, links, own = settle((row, links, state.slot))
    change = jnp.einsum("mkij,mi->mkj", links, step)
    return state._replace(
        slot=own,
        landmarks=state.landmarks.at[slot].add(step, mode="drop"),
        owed=state.owed.at[row.reshape(-1)].add(-change.reshape(-1, 2), mode="drop"),
    )


def relaxed(state: Sparse, share: int) -> Sparse:
    """The means of the next `share` landmarks, those that are passive, one after the other."""
    n = state.own.shape[0]

    def one(state: Sparse, i: jax.Array) -> tuple[Sparse, None]:
        slot = (state.turn + i) % n
        step, positive = linalg.solve_psd(state.own[slot], state.owed[slot])
        on = state.alive[slot] & positive & ~(state.slot == slot).any()
        step = jnp.where(on, step, 0.0)
        state = passed_on(state, slot[None], step[None])
        left = state.owed.at[jnp.where(on, slot, n)].set(0.0, mode="drop")
        return state._replace(owed=left), None

    state, _ = jax.lax.scan(one, state, jnp.arange(share))
    return state._replace(turn=((state.turn + share) % n).astype(jnp.int32))


def solved(
    state: Sparse, omega: jax.Array, owed: jax.Array, sound: jax.Array
) -> tuple[Sparse, jax.Array]:
    """The means of the area moved by Ω⁻¹ ρ, of Ω (3 + 2A, 3 + 2A), and whether that is definite.

    Where it is not, or not sound (), means and ρ stay as they are. Ω of the state is left alone.
    """
    step, positive = linalg.solve_psd(omega, owed)
    sound = sound & positive
    step = jnp.where(sound, step, 0.0)
    state = owing(state, jnp.where(sound, 0.0, owed_of(state)))
    state = state._replace(pose=canonical.stepped(state.pose, step[:3]))
    return passed_on(state, state.slot, step[3:].reshape(-1, 2)), sound


def swept(state: Sparse, omega: jax.Array, sound: jax.Array, share: int, times: int) -> Sparse:
    """Mean recovery once round, `times` over: the passive share, then the area of Ω."""
    for _ in range(times):
        state = relaxed(state, share)
        state, _ = solved(state, omega, owed_of(state), sound)
    return state
