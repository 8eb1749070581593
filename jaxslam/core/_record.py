"""Names of `core.record` under their old path, and two mechanisms that declared checks replace."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from jaxslam.core.record import (
    as_record,
    check_field,
    function_of,
    is_record,
    record,
    set_field,
    static,
)

__all__ = ["FrozenDict", "as_record", "hold_function", "is_record", "record", "set_field", "static"]


class FrozenDict(dict[Any, Any]):
    """A dict that hashes, as a static field needs; do not change it."""

    @classmethod
    def of(cls, name: str, value: Mapping[Any, Any]) -> "FrozenDict":
        """A dict, and those in it, frozen; ValueError, which begins with the name, on an array."""
        made = {k: cls.of(name, v) if isinstance(v, Mapping) else v for k, v in value.items()}
        for key, each in made.items():
            if isinstance(each, np.ndarray | jax.Array | list):
                raise ValueError(f"{name}: {key}: expected a value that is compared by ==")
        return cls(made)

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(frozenset(self.items()))


def hold_function(of: Any, name: str, parameters: str) -> None:
    """Check a function in `__post_init__`; in its place `field(check=function_of(...))`."""
    check_field(of, name, function_of(*parameters.split(", ")))
