"""What models, filters and worlds are made of."""

from jaxslam.core import claims, logs, noise, protocols, record, slots, types, validation

__all__ = ["claims", "logs", "noise", "protocols", "record", "slots", "types", "validation"]
