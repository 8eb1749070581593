"""Data association: which landmark a measurement is of."""

from jaxslam.association.known import known

__all__ = ["known"]
