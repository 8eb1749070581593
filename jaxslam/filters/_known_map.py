"""The known map of a filter: its fields landmarks and tags, checked and held."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxslam.core._numbers import as_array, is_concrete
from jaxslam.core._record import check_field, set_field
from jaxslam.core.validation import InvalidField


def hold_map(filter: Any) -> None:
    """Check and hold the fields landmarks (N, L) and tags of a filter, in `__post_init__`.

    Raises InvalidField on invalid ones.
    """
    check_field(filter, "landmarks", as_array)
    landmarks, tags = filter.landmarks, filter.tags
    size, shape = len(filter.sensor.landmark), np.shape(landmarks)
    if len(shape) != 2 or shape[1] != size or shape[0] == 0:
        raise InvalidField("landmarks", f"expected shape (at least 1, {size}), got {shape}")
    if not np.issubdtype(jnp.result_type(landmarks), np.number) or jnp.iscomplexobj(landmarks):
        raise InvalidField("landmarks", "expected real numbers")
    if is_concrete(landmarks) and not np.isfinite(np.asarray(landmarks)).all():
        raise InvalidField("landmarks", "expected finite numbers")
    if tags is None:
        return
    most, values = np.iinfo(np.int32).max, np.asarray(tags)
    good = values.shape == shape[:1] and np.issubdtype(values.dtype, np.integer)
    if not good or len(np.unique(values)) != shape[0] or values.min() < 0 or values.max() > most:
        raise InvalidField(
            "tags", f"expected {shape[0]} different ones from 0 to {most}, got {tags!r}"
        )
    set_field(filter, "tags", tuple(values.tolist()))


def map_tags(filter: Any) -> Int[Array, "N"]:
    """The tags (N,) int32 of the known map of a filter."""
    count = np.shape(filter.landmarks)[0]
    return jnp.asarray(range(count) if filter.tags is None else filter.tags, jnp.int32)
