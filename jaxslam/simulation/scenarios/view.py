"""Fields of view: which landmarks a simulated sensor reports."""

from collections.abc import Callable

import jax
import jax.numpy as jnp


def between_ranges(nearest: float, farthest: float) -> Callable[[jax.Array, jax.Array], jax.Array]:
    """A field of view all around, from nearest to farthest metres (both excluded).

    Raises ValueError unless 0 <= nearest < farthest.
    """
    if not 0 <= nearest < farthest:
        raise ValueError(
            f"between_ranges: expected 0 <= nearest < farthest, got {nearest} and {farthest}"
        )

    def visible(pose: jax.Array, landmark: jax.Array) -> jax.Array:
        squared = jnp.sum((landmark[:2] - pose[:2]) ** 2)
        return (squared > nearest**2) & (squared < farthest**2)

    return visible
