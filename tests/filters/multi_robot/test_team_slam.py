"""Several robots in one map: against a plain reference, alone, unknown to each other, in campaigns."""

import dataclasses
from functools import cache, partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import refused, swept
from reference.plane import to_frame
from reference.team import Team
from worlds import draw, judged, narrow, nees, ring

import jaxslam
from jaxslam import filters, motion, sensors, team
from jaxslam.core.types import Log, Scan, Status
from jaxslam.filters import EkfSlam, TeamSlam
from jaxslam.filters.multi_robot import _pose_initialization as pose_initialization
from jaxslam.sensors import Part, Suite
from jaxslam.simulation.scenarios import BetweenRanges

Q = np.diag([0.01, 0.01]) ** 2
R1, R2 = np.diag([0.05, 0.02]) ** 2, np.diag([0.08, 0.03]) ** 2
MOUNT = (0.1, -0.05, 0.3)
STARTS = [
    None,
    ((0.8, 0.6, 1.0), np.diag([0.05, 0.05, 0.05]) ** 2),
    ((-0.7, 1.5, -2.0), np.diag([0.05, 0.05, 0.05]) ** 2),
]
NOTHING = np.zeros((3, 3))


def crew(count=2, mutual=True, reach=3.2):
    eyes = sensors.RangeBearing(R1, mount=MOUNT)
    back = sensors.RangeBearing(R2, mount=(0.0, 0.0, 3.0))
    parts = [Part(eyes, 4, visible=BetweenRanges(0.0, reach))]
    if count < 3:  # three robots of three sensors would compile for long
        parts.append(Part(back, 2, interval=3))
    if mutual and count > 1:
        parts.append(Part(eyes, count - 1, interval=2, sees="robots"))
    return [team.Robot(motion.Increment(Q), Suite((*parts,)), start) for start in STARTS[:count]]


def unknown(robots):
    return [dataclasses.replace(robot, start=None) for robot in robots]


def world(robots, steps=40, **options):
    rng = np.random.default_rng(5)
    around = 2 * np.pi * np.arange(8) / 8
    radius = 3.0 + rng.uniform(-0.5, 0.5, 8)
    points = np.stack([radius * np.cos(around), 1.0 + radius * np.sin(around)], axis=1)
    turns = [4 * np.pi / 100, -0.1, 0.15][: len(robots)]
    controls = np.tile(np.ravel([(0.12, turn) for turn in turns]), (steps, 1))
    return jaxslam.TeamWorld(robots, points, controls, **options)


@cache
def crew_slam(count, known):
    """One filter for all tests of such a crew, so that its program is compiled once.

    That of three has room for four landmarks more than there are, and tags of its own.
    """
    robots = crew(count) if known else unknown(crew(count))
    return TeamSlam(robots, 8) if count < 3 else TeamSlam(robots, 12, tags=(20, 21, 22))


@cache
def drawn(count):
    """The world of a crew, and a function that draws a log of it by seed."""
    scenario = world(crew(count), 30)
    return scenario, lambda seed: draw(scenario, seed)[1]


@cache
def program(filter):
    """The program of a run; `probe` tells the state."""

    def go(log, pose, pose_cov):
        return jaxslam.run(
            filter, log, pose, pose_cov, jax.random.key(0), probe=lambda joint: joint
        )

    return jax.jit(go)


def go(filter, scenario, log):
    start = np.asarray(scenario.pose), np.asarray(scenario.pose_cov)
    return jax.device_get(program(filter)(log, *start))


def as_reference(robots, log, tags):
    """The log as (controls, scans) of the reference: scans[b] of (sensor, tag, z)."""
    for control, z, tag, valid in zip(log.control, *log.scan, strict=True):
        scans, at = [], 0
        for robot in robots:
            scan = []
            for s, places in enumerate(robot.sensors.places):
                scan += [
                    (s, int(tag[k]), np.asarray(z[k])) for k in range(at, at + places) if valid[k]
                ]
                at += places
            scans.append(scan)
        yield np.asarray(control).reshape(len(robots), 2), scans


def reference_of(robots, tags, scenario):
    back = [((0.0, 0.0, 3.0), R2)] if len(robots) < 3 else []
    eyes = [(MOUNT, R1), *back, (MOUNT, R1)]
    plain = [{"Q": Q, "sensors": eyes, "start": r.start} for r in robots]
    return Team(plain, tags, scenario.pose, scenario.pose_cov)


@pytest.mark.sweep
def test_a_team_of_one_is_ekf_slam():
    alone = ring(60)
    log = draw(alone, 0)[1]
    one = TeamSlam([team.Robot(alone.motion, Suite(((alone.sensor, 6),)))], 6)
    a, b = (go(f, alone, log) for f in (EkfSlam(alone.motion, alone.sensor, 6), one))
    chex.assert_trees_all_close((a.estimate, a.info), (b.estimate, b.info), rtol=0, atol=1e-12)


@cache
def started(count):
    """`drawn`, from a start that is not at the origin and not certain."""
    scenario = dataclasses.replace(
        drawn(count)[0], pose=(0.5, -0.2, 0.1), pose_cov=np.diag([0.05, 0.05, 0.02]) ** 2
    )
    return scenario, lambda seed: draw(scenario, seed)[1]


@pytest.mark.parametrize(
    ("count", "way"),
    swept([(2, "known"), (2, "landmarks"), (2, "mutual"), (3, "mutual")], (2, "mutual")),
)
def test_a_team_is_its_plain_reference(count, way):
    """Means, covariances and cross-covariances of everything, step by step, to 1e-9."""
    robots = crew(count)
    scenario, log_of = started(count)
    log = log_of(count)
    if way != "known":
        # At first the others see robots alone, or landmarks alone.
        robots, places = unknown(robots), sum(robots[0].sensors.places)
        of_robots = np.asarray(log.scan.tag) >= 8
        hidden = (of_robots == (way == "landmarks")) & (np.arange(30) < 5)[:, None]
        hidden[:, :places] = False
        valid = np.asarray(log.scan.valid) & ~hidden
        log = log._replace(scan=log.scan._replace(valid=valid))
    first = 8 if count < 3 else 20
    tags, log = tuple(range(first, first + count)), relabelled(log, 8, first)
    trace = go(crew_slam(count, way == "known"), scenario, log)
    plain = reference_of(robots, tags, scenario)
    for t, (controls, scans) in enumerate(as_reference(robots, log, tags)):
        plain.predict(controls)
        plain.update(scans)
        state = jax.tree.map(lambda leaf, t=t: np.asarray(leaf[t]), trace.probe)
        mean = np.concatenate([state.pose, state.landmarks.ravel()])
        slot_of = {int(tag): s for s, tag in enumerate(state.tag) if tag >= 0}
        order = []
        for name, at in plain.at.items():
            if name == ("robot", 0):
                order.append(np.arange(3))
                continue
            slot = slot_of.pop(tags[name[1]] if name[0] == "robot" else name[1])
            order.append(3 + 3 * slot + np.arange(len(at)))
        assert not slot_of
        at = np.concatenate(order)
        by_place = np.concatenate(list(plain.at.values()))
        np.testing.assert_allclose(mean[at], plain.x[by_place], rtol=0, atol=1e-9)
        cov = plain.P[np.ix_(by_place, by_place)]
        np.testing.assert_allclose(state.cov[np.ix_(at, at)], cov, rtol=0, atol=1e-9)
    assert len(plain.at) == 8 + count
    assert plain.entered == [way] * (count - 1) * (way != "known")


@pytest.mark.sweep
def test_padding_stays_inert():
    """Eight landmarks in a table of twelve."""
    scenario, log_of = started(3)
    final = go(crew_slam(3, False), scenario, relabelled(log_of(0), 8, 20)).final
    cov = np.asarray(final.cov)
    np.testing.assert_array_equal(np.asarray(final.landmarks)[:12, 2], 0.0)
    third = 3 + 3 * np.arange(12) + 2
    expected = np.zeros((12, cov.shape[1]))
    expected[np.arange(12), third] = 1.0
    np.testing.assert_array_equal(cov[third], expected)


def relabelled(log, first, to):
    tag = log.scan.tag
    return log._replace(scan=log.scan._replace(tag=np.where(tag >= first, tag - first + to, tag)))


@pytest.mark.sweep
def test_sightings_of_each_other_help():
    """Without landmarks a sighting is all that ties the robots; all covariances shrink."""
    scenario, log_of = drawn(2)
    log = log_of(3)
    valid, tag = np.asarray(log.scan.valid), np.asarray(log.scan.tag)
    landmarks = (tag < 8) & (tag >= 0)
    blind = log._replace(scan=log.scan._replace(valid=valid & ~landmarks))
    deaf = log._replace(scan=log.scan._replace(valid=np.zeros_like(valid)))
    without = log._replace(scan=log.scan._replace(valid=valid & landmarks))

    def covs(log):
        final = go(crew_slam(2, True), scenario, log).final
        return team.poses(final, robots=2)[1]

    spread = {"all": covs(log), "blind": covs(blind), "deaf": covs(deaf), "alone": covs(without)}
    for b in range(2):
        assert np.linalg.eigvalsh(spread["deaf"][b] - spread["blind"][b]).min() > -1e-12
    assert np.trace(spread["blind"][1]) < 0.8 * np.trace(spread["deaf"][1])
    assert np.trace(spread["all"][1]) < np.trace(spread["alone"][1])


def test_nothing_of_an_absent_robot_is_lost():
    """It sees one landmark and nobody: counted, and without effect; then it meets the other."""
    scenario, steps = drawn(2)[0], 30
    places = sum(crew(2)[0].sensors.places)
    z = jnp.tile(jnp.array([2.0, 0.1]), (steps, 2 * places, 1))
    tag = np.full((steps, 2 * places), -1, np.int32)
    tag[:2, 0], tag[:2, places] = 0, 0
    tag[:2, 6], tag[:2, places + 6] = 9, 8  # robot 0 sees 1, 1 sees 0
    valid = tag >= 0
    valid[0, places + 6] = False
    log = Log(jnp.asarray(scenario.controls), Scan(z, tag, valid))
    info = go(crew_slam(2, False), scenario, log).info
    status, slot = np.asarray(info.status), np.asarray(info.slot)
    assert status[0, 0] == Status.BORN
    assert status[0, 6] == status[0, places] == Status.UNMATCHED
    assert status[1, 6] == status[1, places + 6] == Status.BORN
    assert slot[1, 6] == slot[1, places + 6] == 8
    assert status[1, 0] == status[1, places] == Status.FUSED
    assert (status[~valid] == Status.EMPTY).all()


@pytest.mark.parametrize("way", ["mutual", "landmarks"])
def test_a_way_in_is_exact_without_noise(way):
    a, b = np.array([1.0, 2.0, 0.7]), np.array([-1.0, 3.0, -2.5])

    cov = np.eye(2) * 1e-4
    if way == "mutual":
        found = jax.jit(pose_initialization.by_mutual_sight)(
            a, np.eye(3, 9), np.eye(3), (to_frame(a, b[:2]), cov), (to_frame(b, a[:2]), cov)
        )
    else:
        points = np.array([[0.0, 0.5], [3.0, -1.0]])
        seen = to_frame(b, points)
        found = jax.jit(pose_initialization.by_two_landmarks)(
            points, np.eye(4, 9), np.eye(4), seen, np.stack([cov, cov])
        )
    np.testing.assert_allclose(found[0], b, rtol=0, atol=1e-12)


RUNS = 100


@cache
def hundred(report, first):
    """Truth of one of two robots and logs of 100 runs; robot 1 sees landmarks from a step on."""
    eyes = sensors.RangeBearing(R1, mount=MOUNT)
    sight = BetweenRanges(0.0, 3.2)
    other = Part(eyes, 1, interval=2, sees="robots")
    robots = [
        team.Robot(
            motion.Increment(Q), Suite((Part(eyes, 6, start=start, visible=sight), other)), at
        )
        for start, at in ((0, None), (first, STARTS[1]))
    ]
    scenario = world(robots, 30, report=report)
    keys = jax.random.split(jax.random.key(2), RUNS)
    return (
        robots,
        scenario,
        *jax.device_get(jax.jit(jax.vmap(partial(jaxslam.simulate, scenario)))(keys)),
    )


@cache
def many():
    """One program of a filter for 100 logs, both robots unknown; `probe` has the estimates of both."""
    robots, scenario, *_ = hundred(0, 0)
    report = [TeamSlam(unknown(robots), 8, report=b, correction="joint") for b in range(2)]

    def go(log):
        return jaxslam.run(
            report[0],
            log,
            scenario.pose,
            scenario.pose_cov,
            jax.random.key(0),
            probe=lambda joint: [filter.estimate(joint) for filter in report],
        )

    return jax.jit(jax.vmap(go))


@pytest.mark.sweep
@pytest.mark.parametrize(("report", "first"), [(0, 0), (1, 10)])
def test_every_robot_is_honest(report, first):
    """The pose NEES of each of two robots over 100 runs, started from unknown places.

    In the second world robot 1 sees landmarks only later, so that it enters by mutual sight.
    """
    *_, truth, logs = hundred(report, first)
    trace = many()(logs)
    found = judged(truth, trace.probe[report], trace.info)
    assert found["error_position"][0] < 0.15
    assert not (np.asarray(trace.info.status) == Status.UNMATCHED).any()
    for measure, dof in (("nees_pose", 3.0), ("nees_landmarks", 2.0)):
        mean, low, high = found[measure]
        assert low < dof < high, (measure, mean)
        assert nees_at_worst(truth, trace.probe[report]) < 50


def nees_at_worst(truth, estimate):
    """The largest NEES of a position: no run diverges."""
    off = truth.pose - np.asarray(estimate.pose)
    return np.nanmax(nees(off[..., :2], np.asarray(estimate.pose_cov)[..., :2, :2]))


@pytest.mark.sweep
def test_a_team_in_a_campaign():
    """With the cheapest of filters: campaigns draw, bound and score worlds of teams."""
    scenario = hundred(1, 10)[1]
    still = filters.DeadReckoning(scenario.motion, scenario.sensor)
    options = {"block": 2, "devices": jax.devices()[:1]}
    campaign = jaxslam.monte_carlo(scenario, {"still": still}, 2, jax.random.key(2), **options)
    assert campaign.filters["still"].counts["runs"] == 2


@pytest.mark.sweep
def test_a_world_is_the_same_whatever_is_reported():
    robots = crew(3)
    scenarios = [world(robots, 5, report=b) for b in (0, 2)]

    @jax.jit
    def all_of_them(key):
        truths, logs = zip(
            *(jaxslam.simulate(scenario, key) for scenario in scenarios), strict=True
        )
        return truths, logs, scenarios[0].histories(key)

    truths, logs, (starts, paths, _) = all_of_them(jax.random.key(0))
    chex.assert_trees_all_equal(*logs)
    for b, truth in zip((0, 2), truths, strict=True):
        np.testing.assert_array_equal(truth.pose, paths[b])
        np.testing.assert_array_equal(truth.start, starts[b])


def driven_by(theta, log):
    """A run of two robots, one from an unknown place, by all parameters of their models."""
    eyes = sensors.RangeBearing(jnp.diag(theta[:2]) ** 2, mount=theta[2:5])
    robot = team.Robot(motion.Increment(jnp.diag(theta[5:7]) ** 2), Suite(((eyes, 3),)))
    filter = TeamSlam([robot, robot], 8, correction="joint")
    return jaxslam.run(filter, log, np.zeros(3), NOTHING, jax.random.key(0))


@pytest.mark.sweep
def test_gradients_are_finite_and_float32_is_near():
    """Through births, corrections and the way in by two landmarks."""
    eyes = sensors.RangeBearing(R1, mount=MOUNT)
    sight = Suite((Part(eyes, 3, visible=BetweenRanges(0.0, 3.2)),))
    scenario = world([team.Robot(motion.Increment(Q), sight, at) for at in STARTS[:2]], 4)
    _, log = draw(scenario, 0)

    def loss(theta):
        trace = driven_by(theta, log)
        return trace.info.log_likelihood.sum(), trace

    theta = np.array([0.05, 0.02, 0.1, 0.0, 0.3, 0.01, 0.01])
    slope, double = jax.device_get(jax.jit(jax.grad(loss, has_aux=True))(theta))
    assert np.isfinite(slope).all()
    assert (slope != 0).all()
    found = jax.device_get(jax.jit(driven_by)(*narrow((theta, log))))
    assert found.final.cov.dtype == jnp.float32
    np.testing.assert_allclose(found.estimate.pose, double.estimate.pose, atol=2e-4)
    np.testing.assert_array_equal(found.info.status, double.info.status)
    assert (double.info.status == Status.BORN).sum() > 2


def compass_only():
    return team.Robot(motion.Increment(Q), Suite(((sensors.Compass([[0.01]]), 1),)))


def signs():
    sensor = sensors.RangeBearingSignature(np.eye(3) * 0.01)
    return team.Robot(motion.Increment(Q), Suite(((sensor, 1),)))


@refused(
    (lambda: TeamSlam([], 3), "at least one robot"),
    (lambda: TeamSlam([ring()], 3), "TeamSlam: robots: expected a Robot, got a Scenario"),
    (lambda: TeamSlam(crew(2)[::-1], 3), "expected no start of robot 0"),
    (
        lambda: TeamSlam(crew(2), 3, tags=(7, 7)),
        r"TeamSlam: tags: expected 2 different ones, of the robots",
    ),
    (
        lambda: TeamSlam(crew(2), 3, tags=(7,)),
        r"TeamSlam: tags: expected 2 different ones, of the robots",
    ),
    (lambda: TeamSlam(crew(2), 3, tags=(7, -1)), "integers >= 0"),
    (lambda: TeamSlam(crew(2), 0), "capacity"),
    (lambda: TeamSlam(crew(2), 3, report=2), "report: expected a number from 0 to 1"),
    (lambda: TeamSlam(crew(2), 3, gate=0.0), "gate: expected a probability above 0 and below 1"),
    (lambda: TeamSlam(crew(2), 3, correction="at once"), "correction: expected"),
    (lambda: TeamSlam([signs()], 3), "expected landmarks \\(x, y\\)"),
    (
        lambda: TeamSlam([crew(1)[0], compass_only()], 3),
        r"TeamSlam: robots\[1\]: expected a start, or a sensor that measures both",
    ),
    (
        lambda: team.Robot(motion.Increment(Q), ring().sensor),
        "sensors: expected a Suite, got a RangeBearing",
    ),
    (lambda: dataclasses.replace(crew(1)[0], start=((0, 0), NOTHING)), "shape"),
    (lambda: world(crew(2), tags=(3, 9)), "expected tags of robots from"),
    (lambda: world(unknown(crew(2))), "expected a start of every robot"),
    (lambda: world(crew(2), report=2), "report: expected a number from 0 to 1"),
)
def test_bad_input(make):
    make()


def test_a_scan_with_other_places_is_refused():
    scenario, log_of = drawn(2)
    log = log_of(0)
    short = log._replace(scan=jax.tree.map(lambda leaf: leaf[:, :10], log.scan))
    with pytest.raises(ValueError, match="expected 14 measurement slots"):
        go(crew_slam(2, True), scenario, short)
