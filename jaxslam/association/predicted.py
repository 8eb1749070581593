"""What an association method may look at: the one view of every filter's map."""

from collections.abc import Callable

import jax

from jaxslam.math.gaussians import gaussian_terms
from jaxslam.protocols import Pairs, Prediction, Sensor
from jaxslam.types import Scan


def predicted(
    sensor: Sensor,
    tag: jax.Array,
    alive: jax.Array,
    measurements: Callable[[], tuple[jax.Array, jax.Array]],
    cross: Callable[[], jax.Array],
) -> Prediction:
    """The `Prediction` of N landmarks, every measurement against every landmark for itself.

    ν_ij = z_i ⊖ ẑ_j, S_ij = H_j P H_jᵀ + R_i. What an association does not ask for is not computed.

    Args:
        tag, alive: (N,) of the slots.
        measurements: () -> ẑ (N, Z) and H_j P H_jᵀ (N, Z, Z).
        cross: () -> H_i P H_jᵀ (N, Z, N, Z).
    """

    def pairs(scan: Scan) -> Pairs:
        expected, own = measurements()
        noise = jax.vmap(sensor.noise_cov)(scan.z)
        over_slots = jax.vmap(sensor.residual, in_axes=(None, 0))
        innovation = jax.vmap(over_slots, in_axes=(0, None))(scan.z, expected)
        cov = own[None] + noise[:, None]
        terms = jax.vmap(jax.vmap(gaussian_terms))(innovation, cov)
        possible = scan.valid[:, None] & alive[None, :] & terms.positive
        return Pairs(innovation, cov, terms.distance, terms.log_det, possible)

    return Prediction(tag, alive, pairs, cross)
