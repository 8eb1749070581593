"""How often a filter associates a measurement with the landmark that was truly measured."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxslam.consistency._measures.measure import Measure
from jaxslam.core.types import Status, Trace

MEASURES = (
    Measure("precision", "associations: precision", honest=1, better="larger"),
    Measure("recall", "associations: recall", honest=1, better="larger"),
    Measure("false_landmarks", "false landmarks", honest=0, better="smaller"),
)


def identities(trace: Trace, origin: Int[Array, "T M"]) -> Int[Array, "T N"]:
    """The true landmark in each slot after each step: the origin of the measurement it was
    initialized by, -1 for none. Tags may be wrong, and are not looked at.

    origin: `Truth.origin`.
    """
    count = trace.estimate.alive.shape[1]

    def step(held: Array, row: tuple[Array, ...]) -> tuple[Array, Array]:
        status, slot, origin = row
        at = jnp.where(status == Status.BORN, slot, count)
        held = held.at[at].set(origin, mode="drop")
        return held, held

    nothing = jnp.full(count, -1, origin.dtype)
    held = jax.lax.scan(step, nothing, (trace.info.status, trace.info.slot, origin))[1]
    return jnp.where(trace.estimate.alive, held, -1)


def association_scores(
    trace: Trace, origin: Int[Array, "T M"], held: Int[Array, "T N"]
) -> dict[str, tuple[Array, Array]]:
    """Precision, recall and false landmarks of one run, each as a sum and its weight.

    precision: corrections by a measurement of that landmark, over all corrections. recall: the same
    over the measurements of landmarks that were in the map before the step. false_landmarks: those
    of the final map without a true landmark, or with that of an earlier slot. held: the
    `identities` of the run.
    """
    info = trace.info
    fused = info.status == Status.FUSED
    # A slot may be corrected and then given to a new landmark within one scan.
    before = jnp.pad(held[:-1], [(1, 0), (0, 0)], constant_values=-1)
    landmark_of_slot = jnp.take_along_axis(before, jnp.maximum(info.slot, 0), axis=1)
    correct = (fused & (origin >= 0) & (landmark_of_slot == origin)).sum()
    in_map = (origin >= 0) & (origin[:, :, None] == before[:, None, :]).any(axis=2)
    last, alive = held[-1], trace.estimate.alive[-1]
    same = (last[:, None] == last[None, :]) & alive[None, :]
    again = (same & jnp.tril(jnp.ones(same.shape, bool), -1)).any(axis=1)
    false = alive & (again | (last < 0))
    dtype = trace.estimate.pose.dtype
    return {
        "precision": (correct.astype(dtype), fused.sum()),
        "recall": (correct.astype(dtype), in_map.sum()),
        "false_landmarks": (false.sum().astype(dtype), jnp.asarray(1)),
    }
