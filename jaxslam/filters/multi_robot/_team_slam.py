"""EKF-SLAM of several robots in one joint state (Solà's loop over robots, sensors, landmarks)."""

import dataclasses
from typing import get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam.association._rules import Known
from jaxslam.charts import Euclidean
from jaxslam.core import _validation as validation
from jaxslam.core import slots
from jaxslam.core._numbers import check_count
from jaxslam.core._record import hold_function, record, set_field, static
from jaxslam.core.protocols import Associate, Filter
from jaxslam.core.slots import Joint
from jaxslam.core.types import Estimate, Info, Scan, Status
from jaxslam.filters._ekf.checks import check_choice, check_map_options
from jaxslam.filters._ekf.correction import Covariance
from jaxslam.filters._ekf.ekf_slam import CorrectionOrder, EkfSlam, propagate, update_by_sensor
from jaxslam.filters._reporting import joined_info
from jaxslam.filters.multi_robot._pose_initialization import best_initialization, observed_points
from jaxslam.filters.multi_robot._team import Robot, check_team, poses, sizes
from jaxslam.filters.multi_robot._team_state import (
    SIZE,
    InitialPose,
    TeamSettings,
    check_sensors,
    robots_in_map,
    seen_from,
    seen_from_first,
    with_robot,
)
from jaxslam.math import se2
from jaxslam.math._arrays import Number
from jaxslam.math._xla import where_any
from jaxslam.math.angles import wrap
from jaxslam.sensors._suite import on_ground, split_scan


@record
class TeamSlam(Filter):
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

    robots: tuple[Robot, ...]
    """`team.Robot`s, in a list or tuple; robot 0 starts where the run does, the others relative to
    it"""
    capacity: int = static()
    """landmark slots N"""
    _: dataclasses.KW_ONLY
    tags: tuple[int, ...] | None = static(default=None)
    """R that mean robots; default N, N + 1, …"""
    report: int = static(default=0)
    """the robot of `estimate`; `team.poses` has all"""
    associate: Associate = Known()
    correction: CorrectionOrder = static(default="sequential")
    gate: Number | None = None
    iterations: int = static(default=1)
    """these four as for `EkfSlam`"""
    covariance: Covariance = static(default="plain")
    """"plain" or "joseph", as there"""
    births: int | None = static(default=None)
    """as there, a limit for each sensor"""
    chart = Euclidean()

    def __post_init__(self) -> None:
        name, robots = "TeamSlam", self.robots
        check_count(f"{name}: capacity", self.capacity)
        tags = check_team(name, robots, self.tags, self.capacity)
        set_field(self, "robots", tuple(robots))
        if self.tags is not None:
            set_field(self, "tags", tags)
        for robot in robots:
            validation.check_models(name, robot.motion, robot.sensors)
        validation.check_parts(name, associate=self.associate)
        hold_function(self, "associate", "prediction, scan")
        check_map_options(name, self.capacity, self.gate, self.births)
        check_count(f"{name}: iterations", self.iterations)
        check_choice(name, "correction", self.correction, get_args(CorrectionOrder))
        check_choice(name, "covariance", self.covariance, ("plain", "joseph"))
        if type(self.report) is not int or not 0 <= self.report < len(robots):
            raise ValueError(
                f"{name}: expected report from 0 to {len(robots) - 1}, got {self.report!r}"
            )
        check_sensors(robots)
        super().__post_init__()

    @property
    def controls(self) -> tuple[str, ...]:
        return tuple(name for robot in self.robots for name in robot.motion.controls)

    @property
    def measurements(self) -> tuple[str, ...]:
        return tuple(f"entry {i} of its sensor" for i in range(sizes(self.robots)[2]))

    @property
    def places(self) -> tuple[int, ...]:
        return tuple(places for robot in self.robots for places in robot.sensors.places)

    def init(self, pose: Float[Array, "3"], pose_cov: Float[Array, "3 3"]) -> Joint:
        return _initial_team_state(pose, pose_cov, self._settings)

    def predict(self, state: Joint, u: Float[Array, "U"], key: Array) -> Joint:
        for b, control in enumerate(jnp.split(u, sizes(self.robots)[0][:-1])):
            state = _predicted_robot(state, b, control, self._settings)
        return state

    def update(self, state: Joint, scan: Scan, key: Array) -> tuple[Joint, Info]:
        settings, (_, place_ends, size_z) = self._settings, sizes(self.robots)
        if scan.tag.shape[0] != place_ends[-1]:
            raise ValueError(
                f"TeamSlam: expected {place_ends[-1]} measurement slots in a scan, got "
                f"{scan.tag.shape[0]}"
            )
        scans = split_scan(scan, settings.places)
        infos: dict[int, Info] = {}
        used: dict[int, list[Array]] = {}
        for b in settings.started + settings.unstarted:
            if b in settings.unstarted:
                state, used[b] = initialized(state, b, scans, settings)
                scans = [
                    robot_scan._replace(valid=robot_scan.valid & ~mask)
                    for robot_scan, mask in zip(scans, used[b], strict=True)
                ]
            state, infos[b] = corrected(state, b, scans[b], settings)
        for b, masks in used.items():
            for a, mask in enumerate(masks):
                infos[a] = _reported_initialized(infos[a], mask, settings.slot_of(b))
        return state, joined_info([infos[b] for b in range(len(self.robots))], size_z)

    def estimate(self, state: Joint) -> Estimate:
        capacity, report = self.capacity, self.report
        means, covs, _ = poses(state, len(self.robots))
        every = jnp.arange(capacity)
        blocks = state.cov[3 : 3 + capacity * SIZE, 3 : 3 + capacity * SIZE]
        return Estimate(
            pose=means[report],
            pose_cov=covs[report],
            points=state.landmarks[:capacity, :2],
            point_covs=blocks.reshape(capacity, SIZE, capacity, SIZE)[every, :2, every, :2],
            alive=state.alive[:capacity],
            tag=state.tag[:capacity],
        )

    @property
    def _settings(self) -> TeamSettings:
        capacity, robots = self.capacity, self.robots
        ekfs = tuple(
            EkfSlam(
                robot.motion,
                robot.sensors,
                capacity + len(robots) - 1,
                chart=_HeadingsWrapped(),
                associate=self.associate,
                correction=self.correction,
                gate=self.gate,
                iterations=self.iterations,
                covariance=self.covariance,
                births=self.births,
            )
            for robot in robots
        )
        tags = self.tags or tuple(range(capacity, capacity + len(robots)))
        return TeamSettings(robots, capacity, tags, ekfs)


@record
class _HeadingsWrapped(Euclidean):
    """The Euclidean chart of landmarks that are robots, (x, y, θ)."""

    def retract(self, pose: Array, landmark: Array, dx: Array, dl: Array) -> tuple[Array, Array]:
        pose, landmark = super().retract(pose, landmark, dx, dl)
        return pose, jnp.concatenate([landmark[:2], wrap(landmark[2:])])


def _initial_team_state(
    pose: Float[Array, "3"], pose_cov: Float[Array, "3 3"], settings: TeamSettings
) -> Joint:
    """The initial state: robot 0 at a pose, the others relative to it, x_b = x_0 ∘ start_b."""
    slots_in_all = settings.capacity + len(settings.robots) - 1
    joint = slots.empty(pose, pose_cov, slots_in_all, SIZE)
    for b, robot in enumerate(settings.robots):
        if robot.start is None:
            continue
        mean, robot_cov = (jnp.asarray(part, pose.dtype) for part in robot.start)
        by_first, by_start = jax.jacfwd(se2.compose, argnums=(0, 1))(pose, mean)
        cov = by_first @ pose_cov @ by_first.T + by_start @ robot_cov @ by_start.T
        rows = by_first @ joint.cov[:3]
        new = InitialPose(se2.compose(pose, mean), rows, cov, jnp.asarray(True))
        joint = with_robot(joint, b, new, settings)
    return joint


def _predicted_robot(
    joint: Joint, robot: int, u: Float[Array, "U"], settings: TeamSettings
) -> Joint:
    """The state after the prediction of one robot, if it is in the map."""
    after, _ = propagate(settings.ekfs[robot], seen_from(joint, robot, settings), u)
    after = seen_from_first(after, robot, joint, settings)
    if robot in settings.started:
        return after
    in_map = joint.alive[settings.slot_of(robot)]
    same: Joint = jax.tree.map(lambda new, old: jnp.where(in_map, new, old), after, joint)
    return same


def initialized(
    joint: Joint, robot: int, scans: list[Scan], settings: TeamSettings
) -> tuple[Joint, list[Bool[Array, "M"]]]:
    """The state with a robot's pose initialized, if possible, and the measurements used for it."""

    absent = ~joint.alive[settings.slot_of(robot)]

    def initialize(joint: Joint) -> tuple[Joint, list[Array]]:
        observed = [
            observed_points(one.sensors, robot_scan)
            for one, robot_scan in zip(settings.robots, scans, strict=True)
        ]
        in_map = robots_in_map(joint, settings)
        new, used = best_initialization(joint, robot, observed, in_map, settings)
        ok = new.possible & absent
        after = with_robot(joint, robot, new, settings)
        after = jax.tree.map(lambda x, y: jnp.where(ok, x, y), after, joint)
        return after, [mask & ok for mask in used]

    def leave(joint: Joint) -> tuple[Joint, list[Array]]:
        return joint, [jnp.zeros_like(robot_scan.valid) for robot_scan in scans]

    return where_any(absent, initialize, leave, joint)


def corrected(joint: Joint, robot: int, scan: Scan, settings: TeamSettings) -> tuple[Joint, Info]:
    """The state corrected by one robot's scan, by measurements whose robots are all in the map."""
    in_map = robots_in_map(joint, settings)
    of_robot = scan.tag[:, None] == jnp.asarray(settings.tags, jnp.int32)[None, :]
    others = jnp.where(jnp.arange(len(in_map)) == robot, False, in_map)
    unknown = (of_robot & ~others[None, :]).any(axis=1) | ~in_map[robot]
    after = seen_from(joint, robot, settings)
    ekf, sensors, infos = settings.ekfs[robot], settings.robots[robot].sensors, []
    is_robot = jnp.arange(len(joint.alive)) >= settings.capacity
    of_sensors = split_scan(scan._replace(valid=scan.valid & ~unknown), sensors.places)
    for part, part_scan in zip(sensors.parts, of_sensors, strict=True):
        sensor = on_ground(part.sensor, SIZE)
        part_scan = part_scan._replace(z=part_scan.z[:, : len(sensor.measurements)])
        births = 0 if part.sees == "robots" else ekf.births
        after, part_info, _, _ = update_by_sensor(
            ekf, sensor, after, part_scan, births, reserved=is_robot
        )
        infos.append(part_info)
    info = joined_info(infos, scan.z.shape[1])
    status = jnp.where(scan.valid & unknown, Status.UNMATCHED, info.status)
    info = info._replace(status=status.astype(jnp.int32))
    return seen_from_first(after, robot, joint, settings), info


def _reported_initialized(info: Info, used: Bool[Array, "M"], slot: int) -> Info:
    """The `Info` with these measurements marked as having initialized a robot."""
    return info._replace(
        status=jnp.where(used, Status.BORN, info.status).astype(jnp.int32),
        slot=jnp.where(used, slot, info.slot).astype(info.slot.dtype),
    )
