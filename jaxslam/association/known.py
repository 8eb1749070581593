"""Association given with the data."""

import jax

from jaxslam import slots
from jaxslam.protocols import Associate, Prediction
from jaxslam.types import Scan


def known() -> Associate:
    """A measurement belongs to the landmark of its tag; an unseen tag starts a new one.

    A measurement of unknown identity (tag -1) is neither, and the filter counts it as rejected.
    """

    def associate(prediction: Prediction, scan: Scan) -> tuple[jax.Array, jax.Array]:
        slot, found = slots.find(prediction.tag, prediction.alive, scan.tag)
        tagged = scan.valid & (scan.tag >= 0)
        found = found & tagged
        return jax.numpy.where(found, slot, -1), tagged & ~found

    return associate
