"""Gates of associations and of new landmarks, and mutually nearest pairs."""

from numbers import Real

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.core.numbers import is_concrete
from jaxslam.math.arrays import Number
from jaxslam.protocols import Pairs, Prediction
from jaxslam.types import Scan


def check_gates(name: str, gate: Number, new_gate: Number | None) -> None:
    """Raise ValueError on a gate below 0 or that is no number, or a new_gate below it."""
    for each in (gate, new_gate):
        if each is not None and not isinstance(each, Real | np.ndarray | jax.Array):
            called = isinstance(each, Prediction | Scan)
            again = f": as associate, give {name}(gate), not {name}" if called else ""
            raise ValueError(f"{name}: expected a number as gate, got {type(each).__name__}{again}")
    if is_concrete(gate) and not np.asarray(gate) >= 0:
        raise ValueError(f"{name}: expected a gate of at least 0, got {gate}")
    if new_gate is not None and is_concrete((gate, new_gate)) and not new_gate >= gate:
        raise ValueError(f"{name}: expected new_gate >= gate = {gate}, got {new_gate}")


def far_from_all(
    pairs: Pairs, scan: Scan, gate: Number, new_gate: Number | None
) -> Bool[Array, "M"]:
    """Whether a measurement lies beyond the gate for new landmarks, by default the other one, of
    every landmark of the map."""
    near = pairs.possible & (pairs.distance <= (gate if new_gate is None else new_gate))
    return scan.valid & ~near.any(axis=1)


def mutual(score: Float[Array, "M N"], allowed: Bool[Array, "M N"]) -> Int[Array, "M"]:
    """The slot of each measurement whose scores are mutually lowest, else -1."""
    if 0 in score.shape:
        return jnp.full(score.shape[0], -1, jnp.int32)
    score = jnp.where(allowed, score, jnp.inf)
    slot = jnp.argmin(score, axis=1).astype(jnp.int32)
    best = jnp.argmin(score, axis=0)[slot] == jnp.arange(score.shape[0])
    return jnp.where(allowed.any(axis=1) & best, slot, -1)
