"""EKF-SLAM of several robots in one joint state (Solà's loop over robots, sensors, landmarks)."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam.charts import Euclidean
from jaxslam.core import slots
from jaxslam.core._record import record
from jaxslam.core.slots import Joint
from jaxslam.core.types import Estimate, Info, Scan, Status
from jaxslam.core.validation import InvalidField
from jaxslam.filters._ekf.ekf_slam import EkfSlam, update_by_sensors
from jaxslam.filters._reporting import join_infos
from jaxslam.filters.multi_robot._pose_initialization import best_initialization, observed_points
from jaxslam.filters.multi_robot._team_filter import SIZE, TeamFilter
from jaxslam.filters.multi_robot._team_state import (
    InitialPose,
    robots_in_map,
    seen_from,
    seen_from_first,
    with_robot,
)
from jaxslam.filters.multi_robot.team import poses
from jaxslam.math import se2
from jaxslam.math._xla import where_any
from jaxslam.math.angles import wrap
from jaxslam.sensors._suite import on_ground, split_scan
from jaxslam.sensors._team import sizes


@record
class TeamSlam(TeamFilter):
    """EKF-SLAM of R robots and one map, with all their cross-covariances.

    The state is a `slots.Joint`: robot 0 is its pose, slots 0 … N-1 hold landmarks (x, y, padding),
    and slot N - 1 + b robot b = 1 … R-1, as a landmark (x, y, θ). Robot b moves and measures by
    exchanging it with robot 0. So a measurement of one robot by another is the correction of a
    landmark, and with R = 1 this is `EkfSlam`. Jacobians are taken at the estimate.

    The control of a step is (u_0, …, u_{R-1}); the measurement slots of a scan are those of robot
    0's sensors in order, then robot 1's, and so on. All robots move; then each in turn (those
    without start last) corrects the map sensor by sensor, and initializes its new landmarks. (In
    Solà 2.4 a robot moves and measures before the next one moves: all controls and measurements of
    a step here are of one time, and a robot that is measured must be where it was then.) Info
    of a robot that was measured has that robot's slot. The tag of a measurement identifies the
    robot; in slots of a `Part` that sees "robots" no landmark is initialized (`Status.DEFERRED`).

    A robot without start has no pose in the map, and its control and measurements change nothing
    (those of it and by it are `Status.UNMATCHED`), until in some step, after the corrections of
    robots with a start, another robot measures it and it measures that one in the same scan
    (`by_mutual_sight` of `pose_initialization`), or it measures two landmarks of the map
    (`by_two_landmarks`, of the two farthest apart). Of several poses it takes the one whose heading
    has the least variance. The two measurements used are `Status.BORN` with its slot, and the rest
    of its scan corrects. This requires tags, and sensors whose measurement determines a point.

    Raises ValueError without robots, on tags that clash, no such robot to report, landmarks that
    are not (x, y), a robot without start whose sensors cannot tell where it is, or as `EkfSlam`
    does.
    """

    def init(self, pose: Float[Array, "3"], pose_cov: Float[Array, "3 3"]) -> Joint:
        joint = slots.empty(pose, pose_cov, self.capacity + len(self.robots) - 1, SIZE)
        for b, robot in enumerate(self.robots):
            if robot.start is None:
                continue
            # x_b = x_0 ∘ start_b
            mean, robot_cov = (jnp.asarray(part, pose.dtype) for part in robot.start)
            by_first, by_start = jax.jacfwd(se2.compose, argnums=(0, 1))(pose, mean)
            cov = by_first @ pose_cov @ by_first.T + by_start @ robot_cov @ by_start.T
            rows = by_first @ joint.cov[:3]
            new = InitialPose(se2.compose(pose, mean), rows, cov, jnp.asarray(True))
            joint = with_robot(self, joint, b, new)
        return joint

    def predict(self, state: Joint, u: Float[Array, "U"], key: Array) -> Joint:
        for b, control in enumerate(jnp.split(u, sizes(self.robots)[0][:-1])):
            ahead = self.ekf_of(b).predict(seen_from(self, state, b), control, key)
            ahead = seen_from_first(self, ahead, b, state)
            if b in self.unstarted:  # it moves once it has a pose in the map
                in_map = state.alive[self.slot_of(b)]
                ahead = jax.tree.map(partial(jnp.where, in_map), ahead, state)
            state = ahead
        return state

    def update(self, state: Joint, scan: Scan, key: Array) -> tuple[Joint, Info]:
        _, place_ends, size_z = sizes(self.robots)
        if scan.tag.shape[0] != place_ends[-1]:
            raise InvalidField(
                "",
                f"expected {place_ends[-1]} measurement slots in a scan, got {scan.tag.shape[0]}",
                owner="TeamSlam",
            )
        scans = split_scan(scan, self.places_by_robot)
        infos: dict[int, Info] = {}
        used: dict[int, list[Array]] = {}
        # Robots with a start come first, so that they are corrected before one is initialized
        # from them.
        for b in self.started + self.unstarted:
            if b in self.unstarted:
                state, used[b] = _initialize_robot(self, state, b, scans)
                scans = [
                    robot_scan._replace(valid=robot_scan.valid & ~mask)
                    for robot_scan, mask in zip(scans, used[b], strict=True)
                ]
            state, infos[b] = _correct_by_robot(self, state, b, scans[b])
        for b, masks in used.items():
            for a, mask in enumerate(masks):
                # These measurements initialized robot b.
                info, slot = infos[a], infos[a].slot
                infos[a] = info._replace(
                    status=jnp.where(mask, Status.BORN, info.status).astype(jnp.int32),
                    slot=jnp.where(mask, self.slot_of(b), slot).astype(slot.dtype),
                )
        return state, join_infos([infos[b] for b in range(len(self.robots))], size_z)

    def estimate(self, state: Joint) -> Estimate:
        capacity, report = self.capacity, self.report
        means, covs, _ = poses(state, len(self.robots))
        k = jnp.arange(capacity)
        blocks = state.cov[3 : 3 + capacity * SIZE, 3 : 3 + capacity * SIZE]
        return Estimate(
            pose=means[report],
            pose_cov=covs[report],
            points=state.landmarks[:capacity, :2],
            # Slot and entry of the row, then of the column: the (x, y) of each diagonal block.
            point_covs=blocks.reshape(capacity, SIZE, capacity, SIZE)[k, :2, k, :2],
            alive=state.alive[:capacity],
            tag=state.tag[:capacity],
        )

    def ekf_of(self, robot: int) -> EkfSlam:
        """The EKF-SLAM by which a robot moves and corrects the map."""
        return EkfSlam(
            self.robots[robot].motion,
            self.robots[robot].sensors,
            self.capacity + len(self.robots) - 1,
            chart=_WrappedHeadings(),
            associate=self.associate,
            correction=self.correction,
            gate=self.gate,
            iterations=self.iterations,
            covariance=self.covariance,
            births=self.births,
        )


@record
class _WrappedHeadings(Euclidean):
    """The Euclidean chart of landmarks that are robots, (x, y, θ)."""

    def retract(self, pose: Array, landmark: Array, dx: Array, dl: Array) -> tuple[Array, Array]:
        pose, landmark = super().retract(pose, landmark, dx, dl)
        return pose, jnp.concatenate([landmark[:2], wrap(landmark[2:])])


def _initialize_robot(
    filter: TeamSlam, joint: Joint, robot: int, scans: list[Scan]
) -> tuple[Joint, list[Bool[Array, "M"]]]:
    """The state with a robot's pose initialized, if possible, and the measurements used for it."""
    absent = ~joint.alive[filter.slot_of(robot)]

    def initialize(joint: Joint) -> tuple[Joint, list[Array]]:
        observed = [
            observed_points(member.sensors, robot_scan)
            for member, robot_scan in zip(filter.robots, scans, strict=True)
        ]
        in_map = robots_in_map(filter, joint)
        new, used = best_initialization(filter, joint, robot, observed, in_map)
        ok = new.possible & absent
        after = with_robot(filter, joint, robot, new)
        after = jax.tree.map(lambda new, old: jnp.where(ok, new, old), after, joint)
        return after, [mask & ok for mask in used]

    def leave(joint: Joint) -> tuple[Joint, list[Array]]:
        return joint, [jnp.zeros_like(robot_scan.valid) for robot_scan in scans]

    return where_any(absent, initialize, leave, joint)


def _correct_by_robot(filter: TeamSlam, joint: Joint, robot: int, scan: Scan) -> tuple[Joint, Info]:
    """The state corrected by one robot's scan, by measurements whose robots are all in the map."""
    in_map = robots_in_map(filter, joint)
    of_robot = scan.tag[:, None] == jnp.asarray(filter.robot_tags, jnp.int32)[None, :]
    others = jnp.where(jnp.arange(len(in_map)) == robot, False, in_map)
    # Measurements of a robot without a pose in the map, and all by one, cannot correct.
    unknown = (of_robot & ~others[None, :]).any(axis=1) | ~in_map[robot]
    sensors = filter.robots[robot].sensors
    is_robot = jnp.arange(len(joint.alive)) >= filter.capacity
    scans = split_scan(scan._replace(valid=scan.valid & ~unknown), sensors.places)
    parts = []
    for part, part_scan in zip(sensors.parts, scans, strict=True):
        sensor = on_ground(part.sensor, SIZE)
        births = 0 if part.sees == "robots" else filter.births  # a robot is no new landmark
        z = part_scan.z[:, : len(sensor.measurements)]
        parts.append((sensor, part_scan._replace(z=z), births))
    after, info, _ = update_by_sensors(
        filter.ekf_of(robot), seen_from(filter, joint, robot), scan, parts, reserved=is_robot
    )
    status = jnp.where(scan.valid & unknown, Status.UNMATCHED, info.status)
    info = info._replace(status=status.astype(jnp.int32))
    return seen_from_first(filter, after, robot, joint), info
