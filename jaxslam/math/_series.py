"""Power series of functions with removable singularities."""

import jax
import jax.numpy as jnp


def horner(x: jax.Array, coefficients: list[float]) -> jax.Array:
    """Σ cₖ xᵏ, elementwise."""
    total = jnp.full_like(x, coefficients[-1])
    for c in reversed(coefficients[:-1]):
        total = total * x + c
    return total
