"""Data association of a scan by tags: the landmark slot of each measurement."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Int

from jaxslam import slots
from jaxslam.filters.reporting import seen_before
from jaxslam.types import Scan


class TagAssociation(NamedTuple):
    """The landmarks of the M measurements of a scan; measurements without a tag have none."""

    known: Bool[Array, "M"]
    """the landmark is in the map"""
    new: Bool[Array, "M"]
    """it is not, or its tag occurs earlier in the scan"""
    repeated: Bool[Array, "M"]
    """its tag occurs earlier in the scan"""
    has_slot: Bool[Array, "M"]
    """the landmark has a slot, or a slot is free for a new landmark"""
    slot: Int[Array, "M"]
    """this slot; any number where there is none"""


def associate_by_table(tag: Int[Array, "N"], alive: Bool[Array, "N"], scan: Scan) -> TagAssociation:
    """Association by a table of tags; new landmarks get the free slots, lowest first.

    A known landmark may be measured twice in a scan.
    """
    tagged = scan.valid & (scan.tag >= 0)
    found_slot, found = slots.find(tag, alive, scan.tag)
    known, new = tagged & found, tagged & ~found
    repeated = new & seen_before(scan.tag, new)
    free_slot, free = slots.allocate(alive, new & ~repeated)
    slot = jnp.where(new, free_slot, found_slot)
    return TagAssociation(known, new, repeated, known | free, slot)


def associate_by_index(alive: Bool[Array, "N"], scan: Scan) -> TagAssociation:
    """Association where a landmark's slot is its tag; measurements without a tag get slot N.

    Of several measurements of one landmark the first is used, the others are REPEATED.
    """
    capacity = alive.shape[0]
    tagged = scan.valid & (scan.tag >= 0)
    repeated = tagged & seen_before(scan.tag, tagged)
    has_slot = tagged & ~repeated & (scan.tag < capacity)
    slot = jnp.where(has_slot, scan.tag, capacity).astype(jnp.int32)
    known = has_slot & alive.at[slot].get(mode="fill", fill_value=False)
    return TagAssociation(known, tagged & ~known, repeated, has_slot, slot)
