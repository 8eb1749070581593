"""Association restricted to landmarks whose predicted measurement is tight."""

import dataclasses

import jax.numpy as jnp

from jaxslam.core.numbers import is_concrete
from jaxslam.protocols import Associate, Association, Pairs, Prediction
from jaxslam.types import Scan


def certain(associate: Associate, spread: float) -> Associate:
    """An association method restricted to landmarks with √(tr S/Z) <= spread.

    S is the covariance of the innovation. After a long loop that of the first landmarks exceeds the
    distances between landmarks, and single measurements may be associated wrongly. Landmarks
    measured there become new ones at first; `filters.map_management.closing` then associates them
    jointly with the old ones.

    Args:
        associate: the method; one that uses tags alone, as `known`, is not restricted.
        spread: in units of the measurement, which should all be of one kind.
    Raises:
        ValueError: on a spread not above 0.
    """
    if is_concrete(spread) and not spread > 0:
        raise ValueError(f"certain: expected a spread above 0, got {spread}")

    def method(prediction: Prediction, scan: Scan) -> Association:
        def pairs(scan: Scan) -> Pairs:
            found = prediction.pairs(scan)
            variance = jnp.trace(found.cov, axis1=2, axis2=3) / found.cov.shape[-1]
            return found._replace(possible=found.possible & (variance <= spread**2))

        return Association(*associate(dataclasses.replace(prediction, pairs=pairs), scan))

    return method
