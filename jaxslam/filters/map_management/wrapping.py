"""What map managers share: the check of the filter's state, and the step after each update."""

from jaxtyping import Array, Float, PyTree

from jaxslam import validation
from jaxslam.filters.ekf.coordinates.linear_system import LinearizedSteps, LinearSystem
from jaxslam.protocols import Wrapper
from jaxslam.slots import Joint
from jaxslam.types import Info, Scan


class Managed(Wrapper):
    """A filter on a `slots.Joint`, each of whose updates is followed by `manage`.

    It returns its linear system (`Monitored`) if the filter does; what `manage` does is no part
    of it. A subclass defines `manage`, and may extend `init`.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check(Managed, {"manage": "joint, scan, info"})

    def manage(self, joint: Joint, scan: Scan, info: Info) -> tuple[Joint, Info]:
        """The map and the info after a scan."""
        raise NotImplementedError

    def init(self, pose: Float[Array, "3"], pose_cov: Float[Array, "3 3"]) -> Joint:
        joint = self.filter.init(pose, pose_cov)
        if not isinstance(joint, Joint):
            raise ValueError(
                f"{type(self).__name__}: expected a filter whose state is a slots.Joint, as of "
                f"EkfSlam, got {self.filter.name}"
            )
        return joint

    def update(self, state: Joint, scan: Scan, key: Array) -> tuple[Joint, Info]:
        return self._managed(state, scan, self.filter.update(state, scan, key))

    @property
    def linearized(self) -> LinearizedSteps | None:
        steps = self.filter.linearized
        if steps is None:
            return None

        def update(joint: Joint, scan: Scan, key: Array) -> tuple[Joint, Info, LinearSystem]:
            after, info, system = steps.update(joint, scan, key)
            return *self._managed(joint, scan, (after, info)), system

        return LinearizedSteps(steps.predict, update)

    def _managed(self, joint: Joint, scan: Scan, found: PyTree) -> tuple[Joint, Info]:
        name = f"{type(self).__name__}: {self.filter.name}"
        found = validation.state_and_info(name, joint, scan, found)
        return self.manage(found[0], scan, found[1])
