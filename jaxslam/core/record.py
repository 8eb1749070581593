"""Records: frozen dataclasses whose numbers are leaves of a pytree."""

from jaxslam.core._record import record, set_field, static

__all__ = ["record", "set_field", "static"]
