"""What models, filters and worlds are made of."""

from jaxslam.core import logs, noise, protocols, record, slots, types, validation

__all__ = ["logs", "noise", "protocols", "record", "slots", "types", "validation"]
