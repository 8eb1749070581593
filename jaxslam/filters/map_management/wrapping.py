"""What map managers share: the check of the filter's state, and the step after each update."""

import dataclasses
from collections.abc import Callable

from jaxtyping import Array, Float, PyTree

from jaxslam import validation
from jaxslam.filters.ekf.coordinates.linear_system import (
    LinearizedSteps,
    LinearSystem,
    linearized_steps,
)
from jaxslam.protocols import Filter
from jaxslam.slots import Joint
from jaxslam.types import Info, Scan


def joint_of(manager: str, filter: Filter, state: PyTree) -> Joint:
    """The filter's state; ValueError, which names the manager, unless it is a `slots.Joint`."""
    if not isinstance(state, Joint):
        raise ValueError(
            f"{manager}: expected a filter whose state is a slots.Joint, as from ekf_slam, got "
            f"{filter.name}"
        )
    return state


def managed(
    manager: str,
    filter: Filter,
    init: Callable[[Float[Array, "3"], Float[Array, "3 3"]], Joint],
    manage: Callable[[Joint, Scan, Info], tuple[Joint, Info]],
) -> Filter:
    """The filter with another `init`, whose updates are followed by `manage`.

    It returns its linear system (`monitored`) if the filter does; what `manage` does is no part
    of it.
    """

    def checked(joint: Joint, scan: Scan, found: PyTree) -> tuple[Joint, Info]:
        found = validation.state_and_info(f"{manager}: {filter.name}", joint, scan, found)
        return manage(found[0], scan, found[1])

    def update(joint: Joint, scan: Scan, key: Array) -> tuple[Joint, Info]:
        return checked(joint, scan, filter.update(joint, scan, key))

    steps = linearized_steps(filter)
    if steps is not None:
        of_filter = steps.update_linearized

        def update_linearized(
            joint: Joint, scan: Scan, key: Array
        ) -> tuple[Joint, Info, LinearSystem]:
            after, info, system = of_filter(joint, scan, key)
            return *checked(joint, scan, (after, info)), system

        steps = LinearizedSteps(steps.predict_linearized, update_linearized)
    return dataclasses.replace(
        filter,
        name=f"{manager} {filter.name}",
        init=init,
        predict=steps.predict if steps else filter.predict,
        update=steps.update if steps else update,
    )
