"""Global nearest neighbour: the assignment of a whole scan with the least sum of distances."""

import jax.numpy as jnp

from jaxslam.association.gates import check_gates, far_from_all
from jaxslam.core.record import record
from jaxslam.math.arrays import Number
from jaxslam.math.assignment import assign
from jaxslam.protocols import Association, Prediction
from jaxslam.types import Scan


@record
class GlobalNearest:
    """Global nearest neighbour: the assignment that minimizes Σ d² over its pairs, with the gate as
    the cost of a measurement without a landmark.

    Only compatible pairs (d² <= gate) are used; with an infinite gate, the largest number of
    possible pairs. Solved exactly (`assignment.assign`). Blackman & Popoli, "Design and analysis
    of modern tracking systems", 1999, section 6.4. The gates are as those of `nearest`.

    Raises:
        ValueError: on a negative gate, or a new_gate below it.
    """

    gate: Number
    new_gate: Number | None = None

    def __post_init__(self) -> None:
        check_gates("GlobalNearest", self.gate, self.new_gate)

    def __call__(self, prediction: Prediction, scan: Scan) -> Association:
        pairs = prediction.pairs(scan)
        m, n = pairs.distance.shape
        compatible = pairs.possible & (pairs.distance <= self.gate)
        within = jnp.where(compatible, pairs.distance, 0.0)
        alone = jnp.minimum(self.gate, 1 + within.sum())
        cost = jnp.where(compatible, pairs.distance, 2 * alone + 1)
        # One more column for each measurement, which stands for no landmark.
        cost = jnp.concatenate([cost, jnp.broadcast_to(alone, (m, m))], axis=1)
        column = assign(cost)
        slot = jnp.where(column < n, column, -1)
        return Association(slot, far_from_all(pairs, scan, self.gate, self.new_gate) & (slot < 0))
