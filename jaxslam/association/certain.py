"""Association restricted to landmarks whose predicted measurement is tight."""

import dataclasses

import jax.numpy as jnp

from jaxslam.core.numbers import check_positive
from jaxslam.core.record import hold_function, record
from jaxslam.math.arrays import Number
from jaxslam.protocols import Associate, Association, Pairs, Prediction
from jaxslam.types import Scan


@record
class Certain:
    """An association method restricted to landmarks with √(tr S/Z) <= spread.

    S is the covariance of the innovation. After a long loop that of the first landmarks exceeds the
    distances between landmarks, and single measurements may be associated wrongly. Landmarks
    measured there become new ones at first; `filters.map_management.closing` then associates them
    jointly with the old ones.

    Raises ValueError on a spread not above 0.
    """

    associate: Associate
    """the method; one that uses tags alone, as `Known`, is not restricted"""
    spread: Number
    """in units of the measurement, which should all be of one kind"""

    def __post_init__(self) -> None:
        hold_function(self, "associate", "prediction, scan")
        check_positive("Certain", spread=self.spread)

    def __call__(self, prediction: Prediction, scan: Scan) -> Association:
        def pairs(scan: Scan) -> Pairs:
            found = prediction.pairs(scan)
            variance = jnp.trace(found.cov, axis1=2, axis2=3) / found.cov.shape[-1]
            return found._replace(possible=found.possible & (variance <= self.spread**2))

        return Association(*self.associate(dataclasses.replace(prediction, pairs=pairs), scan))
