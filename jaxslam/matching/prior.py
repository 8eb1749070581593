"""What is known of a pose before its scan is matched: a term of the cost."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.math.angles import wrap


class Prior(NamedTuple):
    """A pose that is expected: ½ eᵀ Λ e is added to ½ Σ w r², e = (x - x₀, y - y₀, θ - θ₀)."""

    pose: Float[Array, "3"]
    """(x₀, y₀, θ₀) in the frame of the reference"""
    information: Float[Array, "3 3"]
    """Λ = σ² P₀⁻¹, P₀ the covariance of (x₀, y₀, θ₀) and σ [m] that of a residual r; may be
    singular"""

    def error(self, pose: Float[Array, "3"]) -> Float[Array, "3"]:
        """The error e of a pose from the prior's, with the angle in (-π, π]."""
        off = pose - self.pose
        return jnp.concatenate([off[:2], wrap(off[2:])])

    def cost(self, pose: Float[Array, "3"]) -> Float[Array, ""]:
        """The cost ½ eᵀ Λ e of a pose by the prior."""
        e = self.error(pose)
        return 0.5 * e @ (self.information @ e)


def prior_cost(prior: Prior | None, pose: Float[Array, "3"]) -> Float[Array, ""]:
    """`Prior.cost`; 0 without a prior."""
    return jnp.zeros((), pose.dtype) if prior is None else prior.cost(pose)


def prior_terms(
    prior: Prior | None, pose: Float[Array, "3"]
) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
    """The curvature Λ and the slope Λ e of `Prior.cost`; zeros without a prior."""
    if prior is None:
        return jnp.zeros((3, 3), pose.dtype), jnp.zeros_like(pose)
    return prior.information, prior.information @ prior.error(pose)
