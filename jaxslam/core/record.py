"""Records: frozen dataclasses whose numbers are leaves of a pytree."""

from jaxslam._public import publish
from jaxslam.core._record import (
    Function,
    check_field,
    field,
    function_of,
    record,
    set_field,
    static,
)

__all__ = ["Function", "check_field", "field", "function_of", "record", "set_field", "static"]

publish(__name__)
