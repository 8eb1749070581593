"""The predicted measurements of a map, the input of association methods."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.core.protocols import Pairs, Prediction, Sensor
from jaxslam.core.types import Scan
from jaxslam.math.gaussians import gaussian_terms


def predicted(
    sensor: Sensor,
    tag: Int[Array, "N"],
    alive: Bool[Array, "N"],
    measurements: Callable[[], tuple[Float[Array, "N Z"], Float[Array, "N Z Z"] | None]],
    cross: Callable[[], Float[Array, "N Z N Z"]],
) -> Prediction:
    """The `Prediction` of N landmarks, from predicted measurements and their covariances.

    ν_ij = z_i ⊖ ẑ_j, S_ij = H_j P H_jᵀ + R_i. What a method does not call is not computed.

    Args:
        tag, alive: of the slots.
        measurements: () -> ẑ and H_j P H_jᵀ; None instead of the latter where pose and map have no
            error: then S_ij = R_i, which is factored once a measurement.
        cross: () -> H_i P H_jᵀ.
    """

    def pairs(scan: Scan) -> Pairs:
        expected, landmark_cov = measurements()
        noise = jax.vmap(sensor.noise_cov)(scan.z)
        over_slots = jax.vmap(sensor.residual, in_axes=(None, 0))
        innovation = jax.vmap(over_slots, in_axes=(0, None))(scan.z, expected)
        if landmark_cov is None:
            cov = jnp.broadcast_to(noise[:, None], (*innovation.shape, innovation.shape[2]))
            terms = jax.vmap(jax.vmap(gaussian_terms, in_axes=(0, None)))(innovation, noise)
        else:
            cov = landmark_cov[None] + noise[:, None]
            terms = jax.vmap(jax.vmap(gaussian_terms))(innovation, cov)
        possible = scan.valid[:, None] & alive[None, :] & terms.positive
        return Pairs(innovation, cov, terms.distance, terms.log_det, possible)

    return Prediction(tag, alive, pairs, cross)
