"""Known data association: the data give each measurement's landmark."""

import jax.numpy as jnp

from jaxslam import slots
from jaxslam.protocols import Associate, Association, Prediction
from jaxslam.types import Scan


def known() -> Associate:
    """Association by tags: each measurement is of the landmark of its tag; a new tag starts one.

    A measurement of unknown identity (tag -1) is neither, and becomes `Status.UNMATCHED`.
    """

    def associate(prediction: Prediction, scan: Scan) -> Association:
        slot, found = slots.find(prediction.tag, prediction.alive, scan.tag)
        tagged = scan.valid & (scan.tag >= 0)
        found = found & tagged
        return Association(jnp.where(found, slot, -1), tagged & ~found)

    return associate
