"""The check of the filter's state that map managers share."""

from typing import Any

from jaxslam.protocols import Filter
from jaxslam.slots import Joint


def joint_of(manager: str, filter: Filter, state: Any) -> Joint:
    """The filter's state; ValueError, which names the manager, unless it is a `slots.Joint`."""
    if not isinstance(state, Joint):
        raise ValueError(
            f"{manager}: expected a filter whose state is a slots.Joint, as from ekf_slam, got "
            f"{filter.name}"
        )
    return state
