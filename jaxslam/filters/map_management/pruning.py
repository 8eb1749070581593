"""A filter wrapper that removes landmarks by a rule after each scan."""

from jaxtyping import Array, Float

from jaxslam import validation
from jaxslam.filters.ekf.steps.scan import without_landmarks
from jaxslam.filters.map_management.wrapping import joint_of, managed
from jaxslam.filters.reporting import with_removed
from jaxslam.protocols import Filter, Life
from jaxslam.slots import Joint
from jaxslam.types import Info, Scan


def pruning(filter: Filter, life: Life) -> Filter:
    """The filter with the landmarks removed that a rule selects after each scan.

    The rule's memory is `Joint.life`; `info.extra["pruning"].removed` (N,) bool marks the slots.

    A rule that makes room in a full map acts between association and new landmarks, so it must also
    be an argument of the filter: `pruning(ekf_slam(…, make_room=life), life)`.

    Args:
        filter: whose state is a `slots.Joint`.
        life: as of `jaxslam.life`.
    Raises:
        ValueError: on a filter or life of another type; from `init`, on another state; from
            `update`, on a life that makes room, if the filter does not have it.
    """
    validation.check_record("pruning", "filter", filter, Filter)
    validation.check_record("pruning", "life", life, Life)

    def init(pose: Float[Array, "3"], pose_cov: Float[Array, "3 3"]) -> Joint:
        joint = joint_of("pruning", filter, filter.init(pose, pose_cov))
        return joint._replace(life=life.init(pose, joint.landmarks))

    def manage(joint: Joint, scan: Scan, info: Info) -> tuple[Joint, Info]:
        if life.make_room is not None and "pruning" not in (info.extra or {}):
            raise ValueError(
                f"pruning: {life.name} makes room in a full map, and {filter.name} does not ask it "
                "to: expected pruning(ekf_slam(…, make_room=life), life)"
            )
        memory, dead = life.after(joint, info, lambda: filter.estimate(joint))
        joint = joint._replace(life=memory)
        joint = without_landmarks(joint, dead, square_root=filter.square_root)
        return joint, with_removed(info, dead)

    return managed("pruning", filter, init, manage)
