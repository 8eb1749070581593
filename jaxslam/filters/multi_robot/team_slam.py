"""EKF-SLAM of several robots in one joint state (Solà's loop over robots, sensors, landmarks)."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam import slots, validation
from jaxslam.association.known import known as known_association
from jaxslam.charts.euclidean import euclidean
from jaxslam.filters.ekf.predict import propagate
from jaxslam.filters.ekf.scan import Turn, turn_of, update_by_scan
from jaxslam.filters.ekf.settings import Covariance, EkfSettings, Update, check_covariance_form
from jaxslam.filters.multi_robot.joining import SIZE, best_way, entered, points_seen, sees_in_full
from jaxslam.filters.multi_robot.pose_initialization import Entry
from jaxslam.filters.reporting import joined
from jaxslam.math import se2
from jaxslam.math.angles import wrap
from jaxslam.math.linalg import check_count, check_gate
from jaxslam.math.xla import where_any
from jaxslam.protocols import Associate, Chart, Filter
from jaxslam.simulation.team import Robot, check_team, poses, sizes
from jaxslam.slots import Joint
from jaxslam.types import Estimate, Info, Scan, Status

Array = jax.Array


def team_slam(
    robots: Sequence[Robot],
    capacity: int,
    *,
    tags: Sequence[int] | None = None,
    report: int = 0,
    chart: Chart | None = None,
    associate: Associate | None = None,
    update: Update = "sequential",
    gate: float | None = None,
    iterations: int = 1,
    covariance: Covariance = "plain",
    births: int | None = None,
) -> Filter:
    """EKF-SLAM of R robots and one map, with all their cross-covariances.

    The state is a `slots.Joint`: robot 0 is its pose, slots 0 … N-1 hold landmarks (x, y, padding),
    and slot N - 1 + b robot b = 1 … R-1, as a landmark (x, y, θ). Robot b moves and measures by
    changing places with robot 0. So one robot's sighting of another is the correction of a
    landmark, and with R = 1 this is `ekf_slam`. Jacobians are taken at the estimate.

    The control of a step is (u_0, …, u_{R-1}); the places of a scan are those of robot 0's sensors
    in order, then robot 1's, and so on. All robots move; then each in turn (those without start
    last) corrects the map sensor by sensor, and starts its new landmarks. Info of a fused sighting
    has the slot of the robot seen. Whom a measurement is of, its tag says; in places of a `Part`
    that sees "robots" no landmark is started (`Status.DEFERRED`).

    A robot without start is nowhere, and its control and measurements change nothing (those of it
    and by it are `Status.UNMATCHED`), until in some step, after the corrections of robots with a
    start, another robot sees it and it sees that one in the same scan (`by_mutual_sight` of
    `pose_initialization`), or it sees two landmarks of the map (`by_two_landmarks`, of the two
    farthest apart). Of
    several ways it takes the one that tells its heading best. The two measurements used are
    `Status.BORN` with its slot, and the rest of its scan corrects. That takes tags, and sensors
    that leave nothing free of what they see.

    Args:
        robots: `team.Robot`s; robot 0 starts where the run does, the others relative to it.
        capacity: landmark slots N.
        tags: (R,) that mean robots; default N, N + 1, ….
        report: which robot `estimate` is of; `team.poses` has all.
        chart: `charts.euclidean()` or None; no other.
        associate, update, gate, iterations, births: as for `ekf_slam`; births are a sensor.
        covariance: "plain" or "joseph", as there.
    Raises:
        ValueError: without robots, on tags that clash, another chart, no such robot to report,
            landmarks that are not (x, y), a robot without start whose sensors cannot tell it where
            it is, or as `ekf_slam` does.
    """
    tags = check_team("team_slam", robots, tags, _count(capacity))
    for robot in robots:
        validation.check_models("team_slam", robot.motion, robot.sensors)
    validation.check_parts("team_slam", chart=chart, associate=associate)
    _check(robots, report, chart, update, gate, iterations, births)
    check_covariance_form("team_slam", covariance, ("plain", "joseph"))
    count = len(robots)
    control_ends, place_ends, size_z = sizes(robots)
    settings = EkfSettings(
        sensor=robots[0].sensors,
        chart=_headings_wrapped(),
        associate=associate or known_association(),
        update=update,
        gate=gate,
        iterations=iterations,
        covariance=covariance,
        births=births,
        reserved=np.arange(capacity + count - 1) >= capacity,
    )
    for_robots = dataclasses.replace(settings, births=0)
    turns: list[list[Turn]] = [
        [
            turn_of(part, SIZE, for_robots if part.sees == "robots" else settings)
            for part in robot.sensors.parts
        ]
        for robot in robots
    ]
    named = jnp.asarray(tags, jnp.int32)
    unknown = [b for b in range(1, count) if robots[b].start is None]

    def slot_of(robot: int) -> int:
        return capacity - 1 + robot

    def placed(joint: Joint) -> Array:
        """Whether each robot is in the map, (R,)."""
        return jnp.concatenate([jnp.ones(1, bool), joint.alive[capacity:]])

    def at_wheel(joint: Joint, robot: int) -> Joint:
        """Robot 0 and another in each other's place; its own inverse, but for who is alive."""
        if robot == 0:
            return joint
        slot = slot_of(robot)
        first, there = slice(0, 3), slice(3 + slot * SIZE, 6 + slot * SIZE)
        cov = joint.cov
        # Whole rows and columns are copied; a gather by index takes every entry singly.
        cov = cov.at[first].set(cov[there]).at[there].set(cov[first])
        cov = cov.at[:, first].set(cov[:, there]).at[:, there].set(cov[:, first])
        return joint._replace(
            pose=joint.landmarks[slot], landmarks=joint.landmarks.at[slot].set(joint.pose), cov=cov
        )

    def driven_by(joint: Joint, robot: int) -> Joint:
        """`at_wheel`, robot 0 in the slot of the other for its tag."""
        if robot == 0:
            return joint
        slot = slot_of(robot)
        return at_wheel(joint, robot)._replace(
            alive=joint.alive.at[slot].set(True), tag=joint.tag.at[slot].set(tags[0])
        )

    def back(joint: Joint, robot: int, was: Joint) -> Joint:
        if robot == 0:
            return joint
        slot = slot_of(robot)
        return at_wheel(joint, robot)._replace(
            alive=joint.alive.at[slot].set(was.alive[slot]),
            tag=joint.tag.at[slot].set(was.tag[slot]),
        )

    def init(pose: Array, pose_cov: Array) -> Joint:
        joint = slots.empty(pose, pose_cov, capacity + count - 1, SIZE)
        for b, robot in enumerate(robots):
            if robot.start is None:
                continue
            mean, own = (jnp.asarray(part, pose.dtype) for part in robot.start)
            by_first, by_start = jax.jacfwd(se2.compose, argnums=(0, 1))(pose, mean)
            cov = by_first @ pose_cov @ by_first.T + by_start @ own @ by_start.T
            entry = Entry(se2.compose(pose, mean), by_first @ joint.cov[:3], cov, jnp.asarray(True))
            joint = entered(joint, slot_of(b), entry, tags[b])
        return joint

    def predict(joint: Joint, u: Array, key: Array) -> Joint:
        for b, robot in enumerate(robots):
            own = u[control_ends[b] - len(robot.motion.controls) : control_ends[b]]
            moved = propagate(driven_by(joint, b), own, robot.motion, settings)
            moved = back(moved, b, joint)
            if b in unknown:
                there = joint.alive[slot_of(b)]
                moved = jax.tree.map(
                    lambda new, old, at=there: jnp.where(at, new, old), moved, joint
                )
            joint = moved
        return joint

    def use(joint: Joint, robot: int, scan: Scan) -> tuple[Joint, Info]:
        """What robot's scan says, as far as all it concerns are in the map."""
        there = placed(joint)
        whom = scan.tag[:, None] == named[None, :]
        someone = jnp.where(jnp.arange(count) == robot, False, there)
        nobody = (whom & ~someone[None, :]).any(axis=1) | ~there[robot]
        own = scan._replace(valid=scan.valid & ~nobody)
        after, info, _ = update_by_scan(driven_by(joint, robot), own, turns[robot])
        status = jnp.where(scan.valid & nobody, Status.UNMATCHED, info.status)
        return back(after, robot, joint), info._replace(status=status.astype(jnp.int32))

    def own_scan(robot: int, scan: Scan) -> Scan:
        first = place_ends[robot] - sum(robots[robot].sensors.places)
        mine: Scan = jax.tree.map(lambda leaf: leaf[first : place_ends[robot]], scan)
        return mine

    def update_map(joint: Joint, scan: Scan, key: Array) -> tuple[Joint, Info]:
        if scan.tag.shape[0] != place_ends[-1]:
            raise ValueError(
                f"team_slam: expected {place_ends[-1]} places of a scan, got {scan.tag.shape[0]}"
            )
        scans = [own_scan(b, scan) for b in range(count)]
        infos: dict[int, Info] = {}
        entries: list[tuple[int, list[Array]]] = []
        for b in [b for b in range(count) if b not in unknown] + unknown:
            if b in unknown:
                joint, used = enter(joint, b, scans)
                entries.append((b, used))
                scans = [
                    own._replace(valid=own.valid & ~mask)
                    for own, mask in zip(scans, used, strict=True)
                ]
            joint, infos[b] = use(joint, b, scans[b])
        for b, used in entries:
            for a in range(count):
                infos[a] = _born(infos[a], used[a], slot_of(b))
        return joint, joined([infos[b] for b in range(count)], size_z)

    def enter(joint: Joint, robot: int, scans: list[Scan]) -> tuple[Joint, list[Array]]:
        """A robot that is nowhere placed, if there is a way; the places (M,) that took."""

        def find(joint: Joint) -> tuple[Joint, list[Array]]:
            seen = [points_seen(*pair) for pair in zip(robots, scans, strict=True)]
            entry, used = best_way(joint, capacity, tags, robot, seen, placed(joint))
            now = entry.possible & ~joint.alive[slot_of(robot)]
            new = entered(joint, slot_of(robot), entry, tags[robot])
            new = jax.tree.map(lambda x, y: jnp.where(now, x, y), new, joint)
            return new, [mask & now for mask in used]

        def stay(joint: Joint) -> tuple[Joint, list[Array]]:
            return joint, [jnp.zeros_like(own.valid) for own in scans]

        return where_any(~joint.alive[slot_of(robot)], find, stay, joint)

    def estimate(joint: Joint) -> Estimate:
        means, covs, _ = poses(joint, count)
        alive = joint.alive[:capacity]
        every = jnp.arange(capacity)
        blocks = joint.cov[3 : 3 + capacity * SIZE, 3 : 3 + capacity * SIZE]
        own = blocks.reshape(capacity, SIZE, capacity, SIZE)[every, :2, every, :2]
        return Estimate(
            pose=means[report],
            pose_cov=covs[report],
            points=joint.landmarks[:capacity, :2],
            point_covs=own,
            alive=alive,
            tag=joint.tag[:capacity],
        )

    return Filter(
        name="team_slam",
        control_size=control_ends[-1],
        measurement_size=size_z,
        init=init,
        predict=predict,
        update=update_map,
        estimate=estimate,
        chart=euclidean(),
        places=tuple(places for robot in robots for places in robot.sensors.places),
    )


def _headings_wrapped() -> Chart:
    """The Euclidean chart of landmarks that are robots, (x, y, θ)."""
    plain = euclidean()

    def retract(pose: Array, landmark: Array, dx: Array, dl: Array) -> tuple[Array, Array]:
        pose, landmark = plain.retract(pose, landmark, dx, dl)
        return pose, jnp.concatenate([landmark[:2], wrap(landmark[2:])])

    return dataclasses.replace(plain, retract=retract)


def _born(info: Info, used: Array, slot: int) -> Info:
    return info._replace(
        status=jnp.where(used, Status.BORN, info.status).astype(jnp.int32),
        slot=jnp.where(used, slot, info.slot).astype(info.slot.dtype),
    )


def _count(capacity: int) -> int:
    check_count("team_slam: capacity", capacity)
    return int(capacity)


def _check(
    robots: Sequence[Robot],
    report: int,
    chart: Chart | None,
    update: str,
    gate: float | None,
    iterations: int,
    births: int | None,
) -> None:
    for name, value in (("iterations", iterations), ("births", births)):
        if value is not None:
            check_count(f"team_slam: {name}", value)
    if type(report) is not int or not 0 <= report < len(robots):
        raise ValueError(f"team_slam: there is no robot {report!r} to report")
    if chart is not None and chart.basis is not None:
        raise ValueError(f"team_slam: expected the chart euclidean, got {chart.name}")
    if update not in ("sequential", "joint"):
        raise ValueError(f'team_slam: expected update "sequential" or "joint", got {update!r}')
    check_gate("team_slam", gate)
    for b, robot in enumerate(robots):
        for part in robot.sensors.parts:
            if len(part.sensor.landmark) not in (0, 2):
                raise ValueError(
                    f"team_slam: the landmarks of {part.sensor.name} are not points (x, y)"
                )
        if (
            b > 0
            and robot.start is None
            and not any(sees_in_full(p.sensor) for p in robot.sensors.parts)
        ):
            raise ValueError(
                f"team_slam: robot {b} has no start, and no sensor that tells both distance and "
                "direction to find it by"
            )
