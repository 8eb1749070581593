"""Known data association: the data give each measurement's landmark."""

import jax.numpy as jnp

from jaxslam import slots
from jaxslam.core.record import record
from jaxslam.protocols import Association, Prediction
from jaxslam.types import Scan


@record
class Known:
    """Association by tags: each measurement is of the landmark of its tag; a new tag starts one.

    A measurement of unknown identity (tag -1) is neither, and becomes `Status.UNMATCHED`.
    """

    def __call__(self, prediction: Prediction, scan: Scan) -> Association:
        slot, found = slots.find(prediction.tag, prediction.alive, scan.tag)
        tagged = scan.valid & (scan.tag >= 0)
        found = found & tagged
        return Association(jnp.where(found, slot, -1), tagged & ~found)
